"""Stage B against brute force over the cloud."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ddakf import Config, Mesh
from ddakf.config import KnnFilter, NearestPoint
from ddakf.garment import model
from ddakf.mesh import vertex_normals
from ddakf.stages import associate
from ddakf.types import Measurement
from tests.physics.shapes import ball, grid_faces
from tests.stages.scenes import associated, cloud_of, kept_points, planes_of, problem_of, rms, scan, tube

CONFIG = Config()
EVERY_POINT = dataclasses.replace(Config.paper(), preprocess=KnnFilter(ratio=10.0))
SENSOR = np.array([0.3, 0.4, 2.0])


def wavy(seed, n=24, spacing=0.025) -> Mesh:
    """A random smooth sheet about 0.6 m wide."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), axis=-1).reshape(-1, 2) * spacing
    height = sum(0.02 * np.sin(grid @ rng.normal(scale=9, size=2) + rng.uniform(0, 6)) for _ in range(3))
    return Mesh(np.column_stack([grid, height]), grid_faces(n, n))


def prepared(mesh, points, sensor=None, config=CONFIG):
    garment = model.build(mesh)
    return garment, cloud_of(points, sensor, mesh.vertices, garment.area, config)


def gates(cloud, config=CONFIG):
    return list(associate.gates(problem_of(config=config, cloud=cloud)))


def spacing(garment, cloud):
    """Mean distance between plane fits, metres."""
    return np.sqrt(garment.area / cloud.surfels.shape[1])


def test_frames_far_apart_may_have_more_passes():
    garment, cloud = prepared(wavy(0), wavy(0).vertices.astype(np.float32))
    base, config = problem_of(garment, cloud=cloud), CONFIG.associate
    spans = np.array([1 / 90, 1 / 30, 0.05, 1 / 15, 0.1, 3.0])
    passes = [len(list(associate.gates(base._replace(dt=dt)))) for dt in spans]
    assert passes == [config.iterations * share for share in (1, 1, 1.5, 2, 3)] + [config.slow_iterations]
    np.testing.assert_allclose([config.settled_below(dt) for dt in spans[:5]], config.tolerance / np.array([1, 1, 1.5, 2, 3]))


# Nearest point ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("gate", [0.005, 0.03, 0.1])
def test_nearest_point_is_exact(seed, gate):
    mesh = wavy(seed)
    garment, cloud = prepared(mesh, scan(mesh.vertices, mesh, 3000, 0.01, seed), config=EVERY_POINT)
    position = mesh.vertices + np.random.default_rng(seed).normal(scale=0.02, size=mesh.vertices.shape)
    position[:5] += 3.0  # far outside the grid
    measurement = associated(position, cloud, garment, gate, NearestPoint())
    distance, index = cKDTree(kept_points(cloud)).query(position)
    clear = np.abs(distance - gate) > 1e-6
    np.testing.assert_array_equal(measurement.found[clear], (distance < gate)[clear])
    found = measurement.found
    assert 0 < found.sum() < len(found)
    np.testing.assert_allclose(np.linalg.norm(measurement.target - position, axis=1)[found], distance[found], atol=1e-6)
    same = np.linalg.norm(measurement.target[found] - kept_points(cloud)[index[found]], axis=1) < 1e-6
    assert same.mean() > 0.999
    assert measurement.normal is None
    assert measurement.visible.all()


# Planes -------------------------------------------------------------------------------------------------------------


def twin(position, normal, cloud, gate, config):
    """The four nearest planes within the gate whose normals agree, blended by inverse squared distance."""
    at, direction = planes_of(cloud)
    target, plane = np.full_like(position, np.nan), np.full_like(position, np.nan)
    for v in range(len(position)):
        agreement = direction @ normal[v]
        if not cloud.oriented:
            agreement = np.abs(agreement)
        distance = np.linalg.norm(at - position[v], axis=1)
        usable = np.flatnonzero((agreement >= config.normal_cosine) & (distance < gate))
        best = usable[np.argsort(distance[usable])[:4]]
        if len(best) == 0:
            continue
        weight = 1.0 / (distance[best] ** 2 + distance[best[0]] ** 2 + (0.25 * cloud.cell) ** 2)
        signed = direction[best] * np.where(direction[best] @ normal[v] < 0, -1.0, 1.0)[:, None]
        target[v] = weight @ at[best] / weight.sum()
        plane[v] = weight @ signed / np.linalg.norm(weight @ signed)
    return target, plane


@pytest.mark.parametrize("sensor", [None, SENSOR], ids=["unknown sensor", "sensor"])
@pytest.mark.parametrize("seed", range(3))
def test_planes_are_near_those_of_brute_force(seed, sensor):
    mesh = wavy(seed)
    garment, cloud = prepared(mesh, scan(mesh.vertices, mesh, 3000, 0.003, seed), sensor)
    position = mesh.vertices + np.random.default_rng(seed).normal(scale=0.004, size=mesh.vertices.shape)
    measurement = associated(position, cloud, garment, 0.05, CONFIG.associate)
    target, plane = twin(position, vertex_normals(position, mesh.faces), cloud, 0.05, CONFIG.associate)
    both = measurement.found & np.isfinite(target[:, 0])
    away = target - position
    along = np.linalg.norm(away - np.einsum("va,va->v", plane, away)[:, None] * plane, axis=1) / spacing(garment, cloud)
    assert measurement.found[along < 0.9 * CONFIG.associate.lateral_gate].mean() > 0.98
    assert not measurement.found[~(along < 1.2 * CONFIG.associate.lateral_gate)].any()
    assert both.mean() > 0.9
    offset = np.einsum("va,va->v", plane, measurement.target - target)[both]
    assert np.sqrt(np.mean(offset**2)) < 0.001
    assert rms((measurement.target - target)[both]) < cloud.cell / 2
    assert (np.einsum("va,va->v", measurement.normal, plane)[both] > np.cos(np.radians(10))).mean() > 0.95


@pytest.mark.parametrize("seed", range(3))
def test_planes_average_the_noise(seed):
    """The surface at the vertex is known better than a point of the cloud is."""
    mesh = wavy(seed)
    garment, cloud = prepared(mesh, scan(mesh.vertices, mesh, 6000, 0.004, seed), SENSOR)
    measurement = associated(mesh.vertices, cloud, garment, 0.05, CONFIG.associate)
    inner = measurement.found & ~mesh.boundary_vertices
    along = np.linalg.norm(measurement.innovation(mesh.vertices), axis=1)[inner]
    assert np.sqrt(np.mean(along**2)) < 0.0025
    np.testing.assert_allclose(np.linalg.norm(measurement.normal[measurement.found], axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize("sensor", [None, np.array([1.5, 0.3, 1.5])], ids=["unknown sensor", "sensor"])
def test_a_wall_across_the_garment_is_not_taken_for_it(sensor):
    """Points of a surface at right angles, as near as they may be."""
    grid = np.stack(np.meshgrid(np.arange(24), np.arange(24), indexing="ij"), axis=-1).reshape(-1, 2) * 0.025
    floor = Mesh(np.column_stack([grid, np.zeros(len(grid))]), grid_faces(24, 24))
    rng = np.random.default_rng(0)
    wall = np.column_stack([np.full(5000, 0.3), rng.uniform(0, 0.6, 5000), rng.uniform(0, 0.3, 5000)])
    garment, cloud = prepared(floor, (wall + rng.normal(scale=0.001, size=wall.shape)).astype(np.float32), sensor)
    assert associated(floor.vertices, cloud, garment, 0.1, CONFIG.associate).found.mean() < 0.01
    anything = dataclasses.replace(CONFIG.associate, normal_cosine=-1.0)
    assert associated(floor.vertices, cloud, garment, 0.1, anything).found.mean() > 0.2


@pytest.mark.parametrize("sensor", [None, SENSOR])
def test_vertices_past_the_end_of_the_cloud_are_not_measured(sensor):
    """A plane is not drawn on to where nothing was seen, however wide the gate."""
    mesh = wavy(3)
    points = scan(mesh.vertices, mesh, 6000, 0.001, 3)
    edge = np.median(points[:, 0])
    garment, cloud = prepared(mesh, points[points[:, 0] < edge], sensor)
    found = associated(mesh.vertices, cloud, garment, 0.1, CONFIG.associate).found
    past = mesh.vertices[:, 0] - edge
    assert not found[past > 2.5 * spacing(garment, cloud)].any()
    assert found[past < -spacing(garment, cloud)].mean() > 0.95


def test_normals_disagreeing_with_the_vertex_are_not_taken():
    """A thin double wall, its front alone scanned: without a match of normals its back would be measured too."""
    mesh = ball(3, 0.2)
    flat = Mesh(mesh.vertices * [1, 1, 0.02], mesh.faces)
    normals = vertex_normals(flat.vertices, flat.faces)
    points = scan(flat.vertices, flat, 6000, 0.0, 0)
    garment, cloud = prepared(flat, points[points[:, 2] > 0], np.array([0.0, 0.0, 3.0]))
    measurement = associated(flat.vertices, cloud, garment, 0.05, CONFIG.associate)
    steep = np.abs(normals[:, 2]) > 0.7
    assert measurement.found[steep & (normals[:, 2] > 0)].mean() > 0.95
    assert not measurement.found[steep & (normals[:, 2] < 0)].any()
    agreement = np.einsum("va,va->v", measurement.normal, normals)[measurement.found]
    assert agreement.min() > 0


def test_vertices_turned_away_from_the_sensor_are_not_visible():
    mesh = tube()
    garment, cloud = prepared(mesh, scan(mesh.vertices, mesh, 6000, 0.002, 0), SENSOR)
    measurement = associated(mesh.vertices, cloud, garment, 0.05, CONFIG.associate)
    normals = vertex_normals(mesh.vertices, mesh.faces)
    toward = SENSOR - mesh.vertices
    cosine = np.einsum("va,va->v", normals, toward) / np.linalg.norm(toward, axis=1)
    assert not measurement.visible[cosine <= CONFIG.associate.facing_cosine].any()
    assert measurement.visible[cosine > 0.2].all()
    assert not measurement.found[~measurement.visible].any()
    assert measurement.found[cosine > 0.2].mean() > 0.95


def test_any_of_several_sensors_makes_a_vertex_visible():
    mesh = tube()
    points = scan(mesh.vertices, mesh, 6000, 0.002, 0)
    eyes = np.array([[0.0, 0.4, 2.0], [0.0, 0.4, -2.0]])
    garment, cloud = prepared(mesh, points, eyes[(points[:, 2] < 0).astype(int)])
    together = associated(mesh.vertices, cloud, garment, 0.05, CONFIG.associate).visible
    apart = []
    for eye in eyes:
        garment, cloud = prepared(mesh, points, eye)
        apart.append(associated(mesh.vertices, cloud, garment, 0.05, CONFIG.associate).visible)
    np.testing.assert_array_equal(together, apart[0] | apart[1])


def test_vertices_hidden_behind_the_garment_take_no_measurement():
    """Two parallel sheets 6 cm apart, both turned to the camera, which sees the front one alone."""
    front = wavy(0)
    both = Mesh(
        np.concatenate([front.vertices, front.vertices - [0, 0, 0.06]]),
        np.concatenate([front.faces, front.faces + front.n_vertices]),
    )
    sensor = np.array([0.3, 0.3, 2.0])
    garment, cloud = prepared(both, scan(front.vertices, front, 5000, 0.002, 0), sensor)
    measurement = associated(both.vertices, cloud, garment, 0.1, CONFIG.associate)
    assert measurement.found[: front.n_vertices].mean() > 0.95
    inner = ~front.boundary_vertices
    assert measurement.found[front.n_vertices :][inner].mean() < 0.05


def test_a_layer_that_the_cloud_does_not_show_hides_nothing():
    """The same two sheets, the front one estimated where there is none: the camera sees the other through it."""
    front = wavy(0)
    both = Mesh(
        np.concatenate([front.vertices, front.vertices - [0, 0, 0.06]]),
        np.concatenate([front.faces, front.faces + front.n_vertices]),
    )
    points = scan(front.vertices, front, 5000, 0.002, 0) - [0, 0, 0.06]
    garment, cloud = prepared(both, points, np.array([0.3, 0.3, 2.0]))
    measurement = associated(both.vertices, cloud, garment, 0.05, CONFIG.associate)
    inner = ~front.boundary_vertices
    assert measurement.found[front.n_vertices :][inner].mean() > 0.95
    assert not measurement.found[: front.n_vertices].any()


def test_vertices_hidden_behind_the_body_take_no_measurement():
    """An arm's breadth in front of the garment hides what lies behind it, and nothing else."""
    mesh, sensor = wavy(0), np.array([0.3, 0.3, 2.0])
    garment, cloud = prepared(mesh, scan(mesh.vertices, mesh, 5000, 0.002, 0), sensor)
    x = mesh.vertices[:, 0]
    arm = mesh.vertices[(x > 0.2) & (x < 0.35)] + [0.0, 0.0, 0.15]
    found = associated(mesh.vertices, cloud, garment, 0.1, CONFIG.associate, body_vertices=arm).found
    inner = ~mesh.boundary_vertices
    assert found[inner & (x > 0.24) & (x < 0.31)].mean() < 0.05
    assert found[inner & ((x < 0.12) | (x > 0.43))].mean() > 0.95


@pytest.mark.parametrize("gate", [0.01, 0.03, 0.1])
@pytest.mark.parametrize("away", [0.005, 0.02, 0.06, 0.2])
def test_the_gate_bounds_the_distance(gate, away):
    mesh = wavy(1)
    garment, cloud = prepared(mesh, scan(mesh.vertices, mesh, 8000, 0.0, 0))
    raised = mesh.vertices + [0.0, 0.0, away]
    for config in (CONFIG.associate, NearestPoint()):
        found = associated(raised, cloud, garment, gate, config).found
        nearest = cKDTree(planes_of(cloud)[0] if config is CONFIG.associate else kept_points(cloud)).query(raised)[0]
        assert not found[nearest > gate + 1e-6].any()
    if away < 0.5 * gate:
        assert associated(raised, cloud, garment, gate, CONFIG.associate).found.mean() > 0.95


@pytest.mark.parametrize("config", [CONFIG, Config.paper()], ids=["default", "paper"])
@pytest.mark.parametrize("points", [np.empty((0, 3), np.float32), np.full((500, 3), 9.0, np.float32)], ids=["empty", "far"])
def test_a_cloud_without_the_garment_measures_nothing(config, points):
    mesh = wavy(2)
    garment, cloud = prepared(mesh, points, config=config)
    passes = gates(cloud, config)
    assert len(passes) == 1
    measurement = associated(mesh.vertices, cloud, garment, passes[0], config.associate)
    assert not measurement.found.any()
    assert not measurement.innovation(mesh.vertices).any()


def test_gates_start_wide_and_narrow():
    mesh = wavy(2)
    _, cloud = prepared(mesh, scan(mesh.vertices, mesh, 2000))
    passes = gates(cloud)
    assert passes[0] == CONFIG.associate.wide_gate
    assert (np.diff(passes) <= 0).all()
    assert passes[-1] >= CONFIG.associate.narrow_gate
    assert len(gates(cloud, Config.paper())) == 1  # the paper associates once


def test_innovation_of_a_plane_is_its_part_along_the_normal():
    mesh = wavy(3)
    garment, cloud = prepared(mesh, scan(mesh.vertices, mesh, 3000, 0.003), SENSOR)
    measurement = associated(mesh.vertices, cloud, garment, 0.05, CONFIG.associate)
    y = measurement.innovation(mesh.vertices)
    found, n = measurement.found, measurement.normal
    np.testing.assert_allclose(np.cross(y, n)[found], 0.0, atol=1e-12)
    expected = np.einsum("va,va->v", n, measurement.target - mesh.vertices)
    np.testing.assert_allclose(np.einsum("va,va->v", n, y)[found], expected[found], atol=1e-12)
    assert not y[~found].any()


@pytest.mark.parametrize("seed", range(2))
def test_passes_inside_a_frame_agree_with_a_fresh_search(seed):
    """Vertices that hardly moved may keep their plane; the answer then differs by less than the sensor's noise."""
    mesh, rng = wavy(seed), np.random.default_rng(seed)
    garment, cloud = prepared(mesh, scan(mesh.vertices, mesh, 4000, 0.003, seed), SENSOR)
    position = mesh.vertices + rng.normal(scale=0.01, size=mesh.vertices.shape)
    last = associated(position, cloud, garment, 0.1, CONFIG.associate)
    for gate in (0.06, 0.03, 0.03):
        position = position + rng.normal(scale=0.002, size=position.shape) * (rng.random((len(position), 1)) < 0.5)
        last = associated(position, cloud, garment, gate, CONFIG.associate, last)
        fresh = associated(position, cloud, garment, gate, CONFIG.associate)
        assert (last.found == fresh.found).mean() > 0.98
        both = last.found & fresh.found
        offset = np.einsum("va,va->v", fresh.normal, last.target - fresh.target)[both]
        assert np.sqrt(np.mean(offset**2)) < 0.001


def test_what_turns_away_between_passes_loses_its_plane():
    mesh = tube()
    garment, cloud = prepared(mesh, scan(mesh.vertices, mesh, 6000, 0.002, 0), SENSOR)
    first = associated(mesh.vertices, cloud, garment, 0.05, CONFIG.associate)
    turned = mesh.vertices * [-1.0, 1.0, -1.0]  # half a turn: what faced the sensor looks away
    later = associated(turned, cloud, garment, 0.05, CONFIG.associate, first)
    assert isinstance(later, Measurement)
    assert not later.found[~later.visible].any()
