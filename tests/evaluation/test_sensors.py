"""Virtual sensors: points lie on what the camera can see, occlusion is real, and every option does what it says."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ddakf.data import sample
from ddakf.errors import InvalidArgument
from ddakf.evaluation import metrics, sensors
from ddakf.evaluation.sensors import Sensor
from ddakf.mesh import Mesh
from ddakf.sequence import Sequence

FRAME = 75
CLEAN = Sensor(noise=0.0, points=10**6)


@pytest.fixture(scope="module")
def sequence():
    return sample()


@pytest.fixture(scope="module")
def to_garment(sequence):
    distance = metrics.SurfaceDistance(Mesh(sequence.garment_rest, sequence.garment_faces))
    return lambda points: distance(points, sequence.garment_vertices[FRAME])


def _capture(sensor, sequence, seed=0):
    return sensor.capture(sequence, FRAME, np.random.default_rng(seed))


@pytest.mark.parametrize("view", ["full", "front", "ring4"])
def test_noiseless_points_lie_on_the_garment(sequence, to_garment, view):
    cloud = _capture(replace(CLEAN, view=view, points=20_000), sequence)
    assert cloud.points.dtype == np.float32
    assert len(cloud.points) > 2000
    assert to_garment(cloud.points).max() < 1e-5


def test_origins_have_the_promised_shapes_and_distances(sequence):
    centre = sequence.garment_vertices[0].astype(float).mean(axis=0)
    assert _capture(replace(CLEAN, view="full", points=100), sequence).sensor_origin is None
    assert np.allclose(_capture(replace(CLEAN, view="front"), sequence).sensor_origin - centre, [0, 0.2, 2])
    ring = _capture(replace(CLEAN, view="ring4", drop=0.3, points=5000), sequence)
    assert ring.sensor_origin.shape == ring.points.shape
    assert np.allclose(np.hypot(*(ring.sensor_origin - centre)[:, [0, 2]].T), 2)
    assert len(np.unique(ring.sensor_origin, axis=0)) == 4


def test_nothing_lies_between_a_point_and_its_camera(sequence):
    cloud = _capture(replace(CLEAN, view="ring4", points=300), sequence)
    meshes = [(sequence.garment_vertices, sequence.garment_faces), (sequence.body_vertices, sequence.body_faces)]
    for vertices, faces in meshes:
        surface = metrics.SurfaceDistance(Mesh.cleaned(vertices[FRAME], faces)[0])
        for share in np.linspace(0.3, 0.99, 24):
            along = cloud.points + share * (cloud.sensor_origin - cloud.points)
            assert surface(along, Mesh.cleaned(vertices[FRAME], faces)[0].vertices).min() > 1e-5


def test_the_front_camera_sees_the_front_and_the_ring_everything_but_folds(sequence):
    vertices = sequence.garment_vertices[FRAME]
    front = cKDTree(_capture(replace(CLEAN, view="front"), sequence).points).query(vertices)[0] < 0.015
    ring = cKDTree(_capture(replace(CLEAN, view="ring4"), sequence).points).query(vertices)[0] < 0.015
    assert 0.2 < front.mean() < 0.6
    assert ring.mean() > 0.8


def test_the_body_occludes(sequence):
    alone = replace_body(sequence)
    assert len(_capture(CLEAN, alone).points) > len(_capture(CLEAN, sequence).points)


def replace_body(sequence):
    return Sequence("alone", sequence.garment_vertices, sequence.garment_faces, sequence.fps, sequence.garment_rest)


@pytest.mark.parametrize("view", ["full", "front", "ring4"])
def test_without_a_mask_the_skin_is_in_the_cloud_but_not_where_cloth_covers_it(sequence, to_garment, view):
    masked = _capture(replace(CLEAN, view=view, points=20_000), sequence).points
    whole = _capture(replace(CLEAN, view=view, points=60_000, segmented=False), sequence).points
    on_skin = to_garment(whole) > 1e-4
    assert on_skin.mean() > 0.2
    if view != "full":
        assert (~on_skin).sum() == pytest.approx(len(masked), rel=0.02)
    skin = metrics.SurfaceDistance(Mesh.cleaned(sequence.body_vertices[FRAME], sequence.body_faces)[0])
    assert skin(whole[on_skin], sequence.body_vertices[FRAME]).max() < 1e-4


def test_noise_has_the_stated_deviation(sequence):
    clean, noisy = _capture(CLEAN, sequence).points, _capture(replace(CLEAN, noise=0.003), sequence).points
    assert (noisy - clean).std() == pytest.approx(0.003, rel=0.03)


def test_limit_drop_and_outliers_have_the_stated_shares(sequence, to_garment):
    everything = len(_capture(CLEAN, sequence).points)
    assert len(_capture(replace(CLEAN, points=1000), sequence).points) == 1000
    assert len(_capture(replace(CLEAN, drop=0.2), sequence).points) == pytest.approx(0.8 * everything, rel=0.05)
    assert len(_capture(replace(CLEAN, drop=1.0), sequence).points) == 0
    far = to_garment(_capture(replace(CLEAN, outliers=0.1), sequence).points) > 1e-4
    assert far.mean() == pytest.approx(0.1, abs=0.02)


def test_the_same_seed_gives_the_same_cloud(sequence):
    sensor = Sensor("ring4", drop=0.1, outliers=0.05)
    first, again, other = (_capture(sensor, sequence, seed).points for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert first.shape != other.shape or not np.array_equal(first, other)


def test_samples_are_uniform_over_the_area():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    points = sensors.sample_surface(vertices, faces, 40_000, np.random.default_rng(0))
    counts = np.histogram2d(points[:, 0], points[:, 1], bins=4, range=[[0, 1], [0, 1]])[0]
    assert counts == pytest.approx(np.full((4, 4), 2500), rel=0.08)


@pytest.mark.parametrize(
    ("field", "value"),
    [("view", "back"), ("points", 0), ("noise", -1), ("noise", np.nan), ("drop", 1.1), ("outliers", -0.1)],
)
def test_options_out_of_range_are_named(field, value):
    with pytest.raises(InvalidArgument, match=field):
        Sensor(**{field: value})
