"""Virtual sensors: points lie on visible surfaces, occlusion is exact, and every option has its stated effect."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ddakf.data import sample
from ddakf.errors import InvalidArgument
from ddakf.evaluation import metrics
from ddakf.evaluation.sensors import captured_frame, depth_errors, virtual_sensor
from ddakf.evaluation.sensors.virtual_sensor import Sensor
from ddakf.files.sequence import Sequence
from ddakf.mesh import Mesh

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
    assert (noisy - clean).std(axis=0) == pytest.approx([0.003] * 3, rel=0.03)
    assert (noisy - clean).mean(axis=0) == pytest.approx([0] * 3, abs=2e-4)


def test_limit_drop_and_outliers_have_the_stated_shares(sequence, to_garment):
    everything = len(_capture(CLEAN, sequence).points)
    assert len(_capture(replace(CLEAN, points=1000), sequence).points) == 1000
    assert len(_capture(replace(CLEAN, drop=0.2), sequence).points) == pytest.approx(0.8 * everything, rel=0.05)
    assert len(_capture(replace(CLEAN, drop=1.0), sequence).points) == 0
    far = to_garment(_capture(replace(CLEAN, outliers=0.1), sequence).points) > 1e-4
    assert far.mean() == pytest.approx(0.1, abs=0.02)


def test_outliers_are_uniform_in_the_box_of_the_cloud_grown_on_every_side():
    cloud = captured_frame.Cloud(np.array([[0, 0, 0], [1, 2, 3]] * 5000, float), None)
    points = replace(CLEAN, outliers=1.0).degrade(cloud, np.random.default_rng(0)).points
    low, high = np.array([0, 0, 0]) - 0.3, np.array([1, 2, 3]) + 0.3
    assert (points >= low).all()
    assert (points <= high).all()
    assert np.percentile(points, [1, 50, 99], axis=0) == pytest.approx(low + np.outer([0.01, 0.5, 0.99], high - low), abs=0.05)


def test_the_same_seed_gives_the_same_cloud(sequence):
    sensor = Sensor("ring4", drop=0.1, outliers=0.05)
    first, again, other = (_capture(sensor, sequence, seed).points for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert first.shape != other.shape or not np.array_equal(first, other)


def test_samples_are_uniform_over_the_area():
    vertices = np.array([[0, 0, 0], [0.05, 0, 0], [0.4, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    faces = np.array([[0, 1, 5], [1, 2, 5], [2, 3, 5], [3, 4, 5]])  # a square, in triangles of 2.5, 17.5, 30 and 50 % of it
    points = virtual_sensor.sample_surface(vertices, faces, 40_000, np.random.default_rng(0))
    counts = np.histogram2d(points[:, 0], points[:, 1], bins=4, range=[[0, 1], [0, 1]])[0]
    assert counts == pytest.approx(np.full((4, 4), 2500), rel=0.08)


# Errors of depth cameras ----------------------------------------------------------------------------------------------


def _along_the_sight(sequence, cloud):
    """Depth z (N,) of the points in the camera of the view ``front``."""
    return virtual_sensor.front_camera(sequence).to_camera(cloud.points)[:, 2]


def test_depth_noise_is_along_the_axis_and_grows_with_the_square_of_the_depth():
    depth = np.full((200, 200), 1.0)
    depth[100:] = 3.0
    noisy = depth_errors.with_axial_noise(depth, 0.002, np.random.default_rng(0))
    assert (noisy - depth)[:100].std() == pytest.approx(0.002, rel=0.03)
    assert (noisy - depth)[100:].std() == pytest.approx(0.002 * 9, rel=0.03)


def test_depth_noise_leaves_the_pixels_where_they_were(sequence):
    clean = _capture(CLEAN, sequence)
    noisy = _capture(replace(CLEAN, depth_noise=0.002), sequence)
    camera = virtual_sensor.front_camera(sequence)
    assert np.abs(camera.project(noisy.points) - camera.project(clean.points)).max() < 1e-3
    error = _along_the_sight(sequence, noisy) - _along_the_sight(sequence, clean)
    assert error.std() == pytest.approx(0.002 * (_along_the_sight(sequence, clean) ** 2).mean(), rel=0.05)


def test_depth_steps_grow_with_the_square_of_the_depth():
    depth = np.linspace(0.8, 4.0, 40_000)[None]
    stepped = depth_errors.quantised(depth, 0.00285)[0]
    values = np.unique(stepped)
    assert np.diff(values) == pytest.approx(0.00285 * values[1:] * values[:-1])
    assert np.abs(stepped - depth).max() < 0.51 * 0.00285 * 4.0**2
    unseen = np.array([[np.inf, 0.0]])
    assert np.array_equal(depth_errors.quantised(unseen, 0.003), unseen)


def test_a_camera_with_steps_delivers_few_depths(sequence):
    cloud = _capture(replace(CLEAN, depth_step=0.00285), sequence)
    assert len(np.unique(np.round(_along_the_sight(sequence, cloud), 5))) < 60
    assert len(np.unique(np.round(_along_the_sight(sequence, _capture(CLEAN, sequence)), 5))) > 2000


def test_fliers_float_behind_edges_only():
    depth = np.full((40, 40), np.inf)
    depth[:, 10:20], depth[:, 20:30] = 2.0, 2.5
    mixed = depth_errors.mixed_at_edges(depth, 1.0, 0.03, 3.0, np.random.default_rng(0))
    changed = mixed != depth
    assert set(np.flatnonzero(changed.any(axis=0))) == {10, 19, 29}
    assert changed[:, [10, 19, 29]].all()
    assert (mixed[:, 10] < 3.0).all()
    assert (mixed[:, 19] < 2.5).all()
    assert mixed[:, 19].mean() == pytest.approx(2.25, abs=0.1)
    none = depth_errors.mixed_at_edges(depth, 0.0, 0.03, 3.0, np.random.default_rng(0))
    assert np.array_equal(none, depth)
    slope = np.broadcast_to(2.0 + 0.02 * np.arange(40), (40, 40))
    assert np.array_equal(depth_errors.mixed_at_edges(slope, 1.0, 0.03, 3.0, np.random.default_rng(0)), slope), "no edge"


def test_a_camera_with_fliers_sees_points_behind_the_outline(sequence, to_garment):
    clean, mixed = (_capture(replace(CLEAN, fliers=share), sequence) for share in (0.0, 0.5))
    off = to_garment(mixed.points) > 0.01
    assert len(mixed.points) == len(clean.points)
    assert 0.01 < off.mean() < 0.2
    assert (_along_the_sight(sequence, mixed) >= _along_the_sight(sequence, clean) - 1e-6).all()


# Occlusion, frame rate ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("view", ["full", "front", "ring4"])
def test_an_occlusion_hides_the_same_part_of_the_cloth_in_its_frames_only(sequence, view):
    sensor = replace(CLEAN, view=view, points=20_000, occlude=(FRAME, FRAME + 1))
    cloud = _capture(sensor, sequence)
    hidden = virtual_sensor.occluded_side(sequence, sensor.occluded)
    nearest = cKDTree(sequence.garment_vertices[FRAME]).query(cloud.points)[1]
    assert len(cloud.points) > 1000
    assert not hidden[nearest].any()
    assert hidden.mean() == pytest.approx(0.4, abs=0.001)
    assert cloud.sensor_origin is None or cloud.sensor_origin.shape in ((3,), cloud.points.shape)
    before, after = (replace(sensor, occlude=frames) for frames in ((FRAME - 5, FRAME), (FRAME + 1, FRAME + 9)))
    everything = _capture(replace(sensor, occlude=None), sequence)
    assert np.array_equal(_capture(before, sequence).points, everything.points)
    assert np.array_equal(_capture(after, sequence).points, everything.points)


def test_the_occluded_side_is_the_wearers_left(sequence):
    hidden = virtual_sensor.occluded_side(sequence, 0.25)
    assert sequence.template[hidden, 0].min() >= sequence.template[~hidden, 0].max()
    assert not virtual_sensor.occluded_side(sequence, 0.0).any()
    assert virtual_sensor.occluded_side(sequence, 1.0).all()


def test_a_recorded_cloud_is_occluded_by_its_points():
    cloud = captured_frame.Cloud(np.random.default_rng(0).normal(size=(1000, 3)), np.zeros((1000, 3)))
    sensor = replace(CLEAN, occlude=(3, 5))
    seen = sensor.degrade(cloud, np.random.default_rng(0), 3)
    assert len(seen.points) == len(seen.sensor_origin) == 600
    assert seen.points[:, 0].max() <= np.sort(cloud.points[:, 0])[600]
    assert len(sensor.degrade(cloud, np.random.default_rng(0), 5).points) == 1000
    assert len(sensor.degrade(cloud, np.random.default_rng(0)).points) == 1000


def test_every_nth_frame_is_taken():
    assert list(replace(CLEAN, every=3).frames(range(4, 12))) == [4, 7, 10]
    assert Sensor().frames(range(7)) == range(7)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("view", "back"), ("points", 0), ("noise", -1), ("noise", np.nan), ("drop", 1.1), ("outliers", -0.1), ("every", 0),
        ("depth_noise", -1), ("depth_step", np.nan), ("fliers", 2), ("occluded", 1.5), ("occlude", (5, 5)), ("occlude", (-1, 5)),
    ],
)  # fmt: skip
def test_options_out_of_range_are_named(field, value):
    with pytest.raises(InvalidArgument, match=field):
        Sensor(**{field: value})


@pytest.mark.parametrize("field", ["depth_noise", "depth_step", "fliers"])
def test_errors_of_a_camera_need_one(field):
    with pytest.raises(InvalidArgument, match="no camera"):
        Sensor(view="full", **{field: 0.01})
