"""Features turn with the scene, and measure what their names say."""

import numpy as np
import pytest

from ddakf.evaluation.baselines.clothfit import features as module
from ddakf.evaluation.baselines.clothfit.features import LONGEST, Features, bent
from ddakf.evaluation.baselines.clothfit.inputs import CHANGE, SCALARS, STILL, VECTORS
from ddakf.evaluation.baselines.clothfit.network import invariants
from ddakf.mesh import Mesh
from tests.evaluation.baselines.clothfit.scene import BODY, GARMENT, swaying, turn


def followed(move, frames=12):
    """The inputs of the last of some frames, everything moved by ``move``."""
    sequence = swaying(frames)
    garment, body = (Mesh(move(mesh.vertices), mesh.faces) for mesh in (GARMENT, BODY))
    features = Features(garment, garment.vertices, body)
    for number in range(1, frames):
        inputs = features.step(move(sequence.body_vertices[number]), sequence.timestamp(number))
    return inputs


def moved(vertices):
    return np.asarray(vertices, np.float64) @ turn(1.1).T + [2.0, 0.0, -1.0]


def test_a_motion_that_keeps_the_vertical_changes_no_input():
    one, two = followed(np.asarray), followed(moved)
    assert moved(one.carried) == pytest.approx(two.carried, abs=1e-6)
    assert invariants(two.vectors, two.scalars) == pytest.approx(invariants(one.vectors, one.scalars), abs=2e-3)


def test_together_with_gravity_no_rigid_motion_does(monkeypatch):
    one, motion = followed(np.asarray), turn(0.7, "x") @ turn(0.4)
    monkeypatch.setattr(module, "DOWN", motion @ module.DOWN)
    two = followed(lambda vertices: np.asarray(vertices, np.float64) @ motion.T)
    assert invariants(two.vectors, two.scalars) == pytest.approx(invariants(one.vectors, one.scalars), abs=2e-3)


def test_vectors_are_in_the_frame_and_turn_into_the_world():
    one, two = followed(np.asarray), followed(moved)
    world_one, world_two = (np.einsum("qab,qvb->qva", i.rotation, i.vectors) for i in (one, two))
    assert world_one @ turn(1.1).T == pytest.approx(world_two, abs=2e-3)


def test_a_still_body_gives_nothing_but_constants():
    features = Features(GARMENT, GARMENT.vertices, BODY)
    for number in range(1, 5):
        inputs = features.step(BODY.vertices, number / 30)
    assert inputs.carried == pytest.approx(GARMENT.vertices, abs=1e-12)
    change = inputs.vectors[:, len(STILL) :]
    assert change == pytest.approx(np.zeros((GARMENT.n_vertices, len(CHANGE), 3)), abs=1e-9)
    depth = inputs.scalars[:, SCALARS.index("depth")] * module.DEEP
    assert np.median(depth) == pytest.approx(0.02, abs=0.005)


def test_a_vertex_has_the_same_inputs_whoever_else_is_asked_for():
    some = np.array([5, 40, 77])
    whole, part = Features(GARMENT, GARMENT.vertices, BODY), Features(GARMENT, GARMENT.vertices, BODY, some)
    sequence = swaying(6)
    for number in range(1, 6):
        one, two = (f.step(sequence.body_vertices[number], number / 30) for f in (whole, part))
    assert one.vectors[some] == pytest.approx(two.vectors)
    assert one.scalars[some] == pytest.approx(two.scalars)


def test_a_finer_mesh_of_the_same_cloth_sees_much_the_same():
    corner = GARMENT.vertices[GARMENT.edges]
    number = {tuple(edge): GARMENT.n_vertices + k for k, edge in enumerate(GARMENT.edges.tolist())}
    split = []
    for a, b, c in GARMENT.faces.tolist():
        p, q, r = (number[tuple(sorted(pair))] for pair in ((a, b), (b, c), (c, a)))
        split += [(a, p, r), (p, b, q), (r, q, c), (p, q, r)]
    finer = Mesh(np.concatenate([GARMENT.vertices, corner.mean(axis=1)]), np.array(split))
    sequence, inputs = swaying(10), []
    for mesh in (GARMENT, finer):
        features = Features(mesh, mesh.vertices, BODY)
        for k in range(1, 10):
            last = features.step(sequence.body_vertices[k], k / 30)
        inputs.append(last.vectors[: GARMENT.n_vertices])
    cloth = [k for k, name in enumerate(VECTORS) if name.startswith("cloth within")]
    assert np.sqrt(np.mean((inputs[0] - inputs[1])[:, cloth] ** 2)) < 0.05
    rest = [k for k in range(len(VECTORS)) if k not in cloth and VECTORS[k] != "cloth's normal"]
    assert inputs[0][:, rest] == pytest.approx(inputs[1][:, rest], abs=1e-9)


def test_long_vectors_are_bent_back_in_their_direction():
    short, long = np.array([0.02, 0.0, 0.01]), np.array([300.0, 0.0, -400.0])
    assert bent(short) == pytest.approx(short, rel=1e-3)
    assert bent(long) == pytest.approx(LONGEST * long / 500, rel=1e-3)
