"""Working mesh: the template rides on it, and the tracker's error does not depend on the template's triangles."""

from dataclasses import replace

import numpy as np
import pytest

from ddakf import Config, Mesh, Tracker, snapshot
from ddakf.evaluation.sensors import Sensor
from ddakf.first_frame import tube
from ddakf.garment import remeshing, working_mesh
from tests.garment.shapes import centre_split, sieve
from tests.stages.scenes import FPS, about, rms
from tests.tracker_runs import ARRAYS, SAMPLE, SHIRT, TUBE, WEARER, assert_same, cloud

NUMBERS = Config().discretisation
FINE = remeshing.subdivided(SHIRT, 0.012)
UNEVEN = centre_split(SHIRT)
FINE_TUBE, _ = remeshing.subdivided(TUBE, 0.012)


@pytest.fixture(scope="module")
def fine():
    return working_mesh.build(FINE[0], NUMBERS)


@pytest.mark.parametrize("mesh", [SHIRT, TUBE], ids=["shirt", "tube"])
def test_an_even_template_that_is_not_too_fine_is_its_own(mesh):
    assert working_mesh.build(mesh, NUMBERS).mesh is mesh


@pytest.mark.parametrize("mesh", [FINE[0], UNEVEN], ids=["fine", "uneven"])
def test_others_get_an_even_one_of_bounded_size(mesh):
    working = working_mesh.build(mesh, NUMBERS)
    assert NUMBERS.working_vertices_least * 0.9 < working.mesh.n_vertices < NUMBERS.working_vertices_most * 1.25
    assert working_mesh.unevenness(working.mesh) < 0.5
    assert working_mesh.unevenness(UNEVEN) > NUMBERS.working_unevenness


@pytest.mark.parametrize(("share", "itself"), [(0.8, True), (0.3, False)])
def test_a_template_of_long_triangles_is_not_even(share, itself):
    """Along their short edges cloth would slide, however even their areas are."""
    long = Mesh(TUBE.vertices * [1.0, share, 1.0], TUBE.faces)
    assert (working_mesh.build(long, NUMBERS).mesh is long) == itself
    assert (working_mesh.elongation(long) < working_mesh.LONGEST) == itself


def test_the_paper_tracks_the_template_itself():
    assert working_mesh.build(FINE[0], Config.paper().discretisation).mesh is FINE[0]


@pytest.mark.parametrize("scale", [0.1, 1.0, 3.0])
def test_the_number_of_vertices_is_bounded_for_every_size(scale):
    mesh = Mesh(scale * FINE[0].vertices, FINE[0].faces)
    count = remeshing.remesh(mesh, working_mesh.working_edge(mesh, NUMBERS)).mesh.n_vertices
    assert 0.9 * NUMBERS.working_vertices_least < count < 1.25 * NUMBERS.working_vertices_most


def test_at_rest_the_template_is_where_it_is(fine):
    still = np.broadcast_to(np.eye(3), (fine.mesh.n_vertices, 3, 3))
    np.testing.assert_allclose(fine.carried(fine.mesh.vertices, still), fine.template.vertices, atol=1e-12)


def test_a_rigid_motion_carries_the_template_rigidly(fine):
    Q, shift = about([1, 2, 3], 0.7), np.array([0.3, -1.0, 2.0])
    turned = np.broadcast_to(Q, (fine.mesh.n_vertices, 3, 3))
    carried = fine.carried(fine.mesh.vertices @ Q.T + shift, turned)
    np.testing.assert_allclose(carried, fine.template.vertices @ Q.T + shift, atol=1e-12)


def test_what_is_linear_over_the_template_is_sampled_and_spread_exactly(fine):
    values = fine.template.vertices @ np.diag([1.0, -2.0, 0.5])
    sampled = fine.sampled(values)
    np.testing.assert_allclose(sampled, fine.mesh.vertices @ np.diag([1.0, -2.0, 0.5]), atol=1e-12)
    assert rms(fine.spread(sampled) - values) < 2e-3  # the working faces are chords


def follow(mesh, vertices, count=6, config=None, **sensor):
    """RMS errors, m, over a template that moves as ``vertices`` of each frame say; and the last result and its tracker."""
    tracker = Tracker(mesh, config=config)
    tracker.reset(vertices(30))
    rng, errors = np.random.default_rng(0), []
    for k in range(31, 31 + count):
        points, origin = Sensor(points=6000, noise=0.003, **sensor).capture(SAMPLE, k, rng)
        result = tracker.step(points, timestamp=SAMPLE.timestamp(k), sensor_origin=origin)
        errors.append(rms(result.vertices - vertices(k)))
    return np.mean(errors), result, tracker


def fine_vertices(k):
    return working_mesh.interpolated(SAMPLE.garment_vertices[k].astype(np.float64), *FINE[1])


def test_the_error_does_not_depend_on_the_triangles():
    own, *_ = follow(SHIRT, lambda k: SAMPLE.garment_vertices[k])
    subdivided, result, _ = follow(FINE[0], fine_vertices)
    rows = np.random.default_rng(0).permutation(SHIRT.n_faces)[: SHIRT.n_faces // 2]

    def with_centres(k):
        vertices = SAMPLE.garment_vertices[k].astype(np.float64)
        return np.concatenate([vertices, vertices[SHIRT.faces[rows]].mean(axis=1)])

    split, *_ = follow(UNEVEN, with_centres)
    assert max(subdivided, split) < 1.1 * own + 3e-4
    assert len(result.vertices) == FINE[0].n_vertices


LOW_POLY = remeshing.remesh(SHIRT, 0.1)
UNSPLIT = Config.from_dict({"discretisation": {"working_coarsest": 1000.0}})


def low_poly_vertices(k):
    return working_mesh.interpolated(SAMPLE.garment_vertices[k].astype(np.float64), LOW_POLY.corner, LOW_POLY.share)


def test_long_edges_of_a_coarse_template_are_split():
    template = LOW_POLY.mesh
    working = working_mesh.build(template, NUMBERS).mesh
    longest = NUMBERS.working_coarsest * max(working_mesh.working_edge(template, NUMBERS), NUMBERS.working_edge)
    assert template.edge_length > 1.4 * longest
    assert np.linalg.norm(np.subtract(*working.vertices[working.edges.T]), axis=1).max() <= longest
    np.testing.assert_array_equal(working.vertices[: template.n_vertices], template.vertices)
    assert remeshing.areas(working).sum() == pytest.approx(remeshing.areas(template).sum())


def test_split_edges_make_a_coarse_template_bend():
    template = LOW_POLY.mesh
    (split, result, _), (own, *_) = (follow(template, low_poly_vertices, config=config) for config in (None, UNSPLIT))
    assert split < 0.9 * own
    assert len(result.vertices) == template.n_vertices


def test_a_snapshot_from_before_edges_were_split_goes_on_with_its_own_mesh():
    _, _, tracker = follow(LOW_POLY.mesh, low_poly_vertices, count=2, config=UNSPLIT)
    numbers, arrays = snapshot.parts(tracker)
    del numbers["config"]["discretisation"]["working_coarsest"]
    other, points = Tracker.restore(snapshot.pack(numbers, arrays)), cloud(1)
    assert_same(other.step(points, timestamp=9.0), tracker.step(points, timestamp=9.0))


def test_results_of_the_template_are_those_of_its_own_mesh_where_it_tracks_itself():
    own = Config.from_dict({"discretisation": {"working_edge": 0.0}})
    a, b = (follow(SHIRT, lambda k: SAMPLE.garment_vertices[k], count=2, config=config)[1] for config in (None, own))
    assert_same(a, b)


def test_a_result_has_a_row_for_each_vertex_of_the_template():
    _, result, tracker = follow(FINE[0], fine_vertices, count=2)
    for name in ARRAYS:
        assert len(getattr(result, name)) == FINE[0].n_vertices
    assert np.isfinite(np.linalg.cholesky(result.covariance)).all()
    assert result.observed.mean() == pytest.approx(result.coverage, abs=0.05)
    np.testing.assert_allclose(result.sigma, np.sqrt(np.trace(result.covariance, axis1=1, axis2=2) / 3))
    later = tracker.predicted(result, 0.02)
    assert later.vertices.shape == result.vertices.shape
    assert (later.sigma >= result.sigma).all()


def test_a_snapshot_goes_on_to_the_bit():
    tracker = Tracker(FINE_TUBE)
    for k in range(3):
        tracker.step(cloud(k), timestamp=k / FPS)
    other = Tracker.restore(tracker.snapshot())
    a, b = (t.step(cloud(3), timestamp=3 / FPS) for t in (tracker, other))
    assert_same(a, b)


def test_a_body_carries_a_fine_template():
    tracker = Tracker(FINE[0], body=WEARER)
    tracker.reset(fine_vertices(0))
    errors = []
    for k in range(1, 6):
        points, origin = Sensor(view="front", points=6000, noise=0.003).capture(SAMPLE, k, np.random.default_rng(k))
        more = {"sensor_origin": origin, "body_vertices": SAMPLE.body_vertices[k]}
        result = tracker.step(points, timestamp=SAMPLE.timestamp(k), **more)
        errors.append(rms(result.vertices - fine_vertices(k)))
    assert np.mean(errors) < 0.02
    assert result.state == "tracking"


def buttoned(vertices, face=None, count=5, radius=0.008):
    """(V + 7 count, 3) vertices of a garment with buttons, hexagons that stand off faces, and (F, 3) faces if asked for.

    Each button goes with its face as what is sewn to it does.
    """
    corners = vertices[SHIRT.faces[:: SHIRT.n_faces // count][:count]].astype(np.float64)
    across = corners[:, 1] - corners[:, 0]
    across /= np.linalg.norm(across, axis=1)[:, None]
    normal = np.cross(across, corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    angle = np.pi / 3.0 * np.arange(6)
    rim = np.cos(angle)[:, None] * across[:, None] + np.sin(angle)[:, None] * np.cross(normal, across)[:, None]
    middle = corners.mean(axis=1)[:, None] + 0.003 * normal[:, None]
    buttons = np.concatenate([middle, middle + radius * rim], axis=1).reshape(-1, 3)
    if face is None:
        return np.concatenate([vertices, buttons])
    hexagon = np.array([[0, 1 + k, 1 + (k + 1) % 6] for k in range(6)])
    return Mesh(
        np.concatenate([vertices, buttons]),
        np.concatenate([face, *(len(vertices) + 7 * k + hexagon for k in range(count))]),
    )


def test_buttons_go_with_the_garment_that_they_lie_on():
    garment = buttoned(SHIRT.vertices, SHIRT.faces)
    assert working_mesh.build(garment, NUMBERS).mesh.n_vertices == SHIRT.n_vertices
    plain, *_ = follow(SHIRT, lambda k: SAMPLE.garment_vertices[k])
    error, result, _ = follow(garment, lambda k: buttoned(SAMPLE.garment_vertices[k]))
    assert error < 1.1 * plain + 3e-4
    off = np.linalg.norm(result.vertices - buttoned(result.vertices[: SHIRT.n_vertices]), axis=1)
    assert off.max() < 0.003


def test_buttons_ride_on_an_even_mesh_of_an_uneven_garment_too():
    garment = buttoned(SHIRT.vertices, SHIRT.faces)
    fine, _ = remeshing.subdivided(garment, 0.012)
    working = working_mesh.build(fine, NUMBERS)
    assert remeshing._topology(working.mesh)[0] == 1
    still = np.broadcast_to(np.eye(3), (working.mesh.n_vertices, 3, 3))
    np.testing.assert_allclose(working.carried(working.mesh.vertices, still), fine.vertices, atol=1e-12)


def test_a_garment_of_small_pieces_keeps_them_all():
    step = np.array([0.3, 0.0, 0.0])
    scarves = Mesh(
        np.concatenate([TUBE.vertices + k * step for k in range(25)]),
        np.concatenate([TUBE.faces + k * TUBE.n_vertices for k in range(25)]),
    )
    assert not working_mesh._in_small_pieces(scarves).any()


def test_an_edge_of_next_to_nothing_is_not_tracked():
    """It would be stiffer than all others, and the solver would not settle."""
    a, b, c = SHIRT.faces[100]
    beside = SHIRT.vertices[a] + 1e-4 * (SHIRT.vertices[[b, c]].mean(axis=0) - SHIRT.vertices[a])
    n, others = SHIRT.n_vertices, np.delete(SHIRT.faces, 100, axis=0)
    sliver = Mesh(np.concatenate([SHIRT.vertices, [beside]]), np.concatenate([others, [[a, b, n], [b, c, n], [c, a, n]]]))
    assert working_mesh.unevenness(sliver) == np.inf
    mesh = working_mesh.build(sliver, NUMBERS).mesh
    assert np.linalg.norm(np.diff(mesh.vertices[mesh.edges], axis=1)[:, 0], axis=1).min() > 0.1 * mesh.edge_length


def test_edges_of_next_to_nothing_give_as_many_vertices_as_there_may_be():
    shortest = replace(NUMBERS, working_edge=1e-300, working_vertices_most=3000)
    assert 2000 < working_mesh.build(FINE_TUBE, shortest).mesh.n_vertices < 4500


def test_a_good_template_is_beyond_doubt(fine):
    assert not any(mesh.doubt for mesh in (fine, *(working_mesh.build(other, NUMBERS) for other in (SHIRT, UNEVEN))))


def test_needles_that_are_tracked_as_they_are_are_told(caplog):
    """A tube of one ring of long triangles was lost at a reliability of nearly 0, without a word of the cause."""
    ring = tube(0.2, 1000, 2)
    Tracker(Mesh(ring.vertices * [1.0, 12.0, 1.0], ring.faces))
    told = "template: expected triangles at most 2.4 times as long as high, got 477 times in the median: it is tracked as it is"
    assert told in caplog.text
    caplog.clear()
    Tracker(SHIRT)
    assert not caplog.text


def test_a_sieve_that_is_tracked_as_it_is_is_told():
    doubt = working_mesh.build(sieve(100, 0.005, 3), NUMBERS).doubt
    assert "edges keeps its 0 openings and 1089 handles: it is tracked as it is, with its 20000 vertices" in doubt


def test_edges_that_are_longer_than_asked_for_are_told():
    finer = replace(NUMBERS, working_edge=0.008)
    asked = "discretisation.working_edge: expected edges of 8 mm, got"
    own = "those of an even template, of which only long ones are split"
    assert working_mesh.build(SHIRT, finer).doubt == f"{asked} 16.7 mm: {own}"
    assert working_mesh.build(FINE[0], finer).doubt.startswith(asked)
    assert working_mesh.build(FINE[0], finer).doubt.endswith("; working_vertices_most is 4000")
    assert not working_mesh.build(FINE[0], replace(finer, working_vertices_most=20_000)).doubt
    assert not working_mesh.build(TUBE, Config.fast().discretisation).doubt  # it asks for coarser edges than the default
