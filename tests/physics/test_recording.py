"""The energies and the body's motion on a recorded garment."""

import numpy as np
import pytest

from ddakf import physics
from ddakf.body import proximity
from ddakf.mesh import Mesh
from ddakf.physics import bend, shear, stretch
from tests.physics.shapes import energy

pytestmark = pytest.mark.recordings


@pytest.fixture(scope="module")
def sequence(recording):
    with np.load(recording("sequences/pergamo_005.npz")) as data:
        return {name: data[name] for name in data.files}


def test_riding_on_the_body_predicts_the_garment(sequence):
    """The root mean square error of the prediction falls below a fifth of that of standing still."""
    garment, poses = sequence["garment_V"].astype(float), sequence["body_V"].astype(float)
    body = proximity.build(Mesh(poses[0], sequence["body_F"]))
    still, ride = [], []
    for frame in range(20, 60, 10):
        now, later = garment[frame], garment[frame + 1]
        contact = proximity.closest_points(body, proximity.refresh(body, poses[frame]), now, 0.1)
        motion = proximity.surface_motion(body, poses[frame], poses[frame + 1], now, contact, 0.1)
        still.append(later - now)
        ride.append(later - motion.position)
    assert np.linalg.norm(ride) < 0.2 * np.linalg.norm(still)


@pytest.mark.parametrize("module", [stretch, shear, bend])
def test_energies_of_a_real_garment_are_finite(sequence, module):
    garment = sequence["garment_V"].astype(float)
    mesh, kept = Mesh.cleaned(garment[0], sequence["garment_F"])
    lin = module.linearize(garment[60][kept], module.build(mesh))
    assert np.isfinite(energy(lin))
    assert np.isfinite(physics.diagonal_blocks(lin, mesh.n_vertices)).all()
