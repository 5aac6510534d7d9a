"""A garment on its body: what is not seen goes with the body as closely as what is seen."""

import dataclasses

import numpy as np
import pytest

from ddakf import Config, Mesh, Tracker, data
from ddakf.body import body_anchor, contact
from ddakf.config import Anchor
from ddakf.files.sequence import load_sequence
from ddakf.garment import model
from ddakf.kernels.normals import vertex_normals
from ddakf.types import Health, Setup, Track
from tests.physics.shapes import ball, sheet
from tests.stages.scenes import FPS, about, inner_body, posed, problem_of, rms, scan, tube
from tests.tracker_runs import SAMPLE, SHIRT

MESH = tube()
BODY = inner_body(MESH)
GARMENT = model.build(MESH)
CONFIG = Anchor()
FRONT = MESH.vertices[:, 2] > 0
PER_VERTEX = MESH.n_vertices / len(GARMENT.likeness)  # variance of a vertex over that of a patch


def normals(position):
    normal = np.empty_like(position)
    vertex_normals(position, GARMENT.faces, normal)
    return normal


def after(deviation, frames=30, measured=FRONT, dt=1 / FPS, start=None):
    """The pseudo-measurements after frames in which the measured vertices were so far (V, 3) from where the body takes them."""
    known = anchored() if start is None else start
    for _ in range(frames):
        known = body_anchor.learn(frame(known, posed(BODY), dt), MESH.vertices + deviation, measured)
    return known, frame(known, posed(BODY)).anchored


def anchored(position=MESH.vertices):
    """The anchor of a garment on the body in its first pose."""
    return body_anchor.start(Setup(GARMENT, contact.build(BODY, 0.1), Config()), BODY.vertices, position)


def frame(anchor, body, dt=1 / FPS):
    """A frame of a tracked garment with this anchor."""
    under = contact.start(contact.build(BODY, 0.1), MESH.vertices, Config().physics)
    last = Track(None, None, None, 0.0, Health(), None, under, anchor)
    return body_anchor.measure(problem_of(GARMENT, None, Config(), last=last, body=body, dt=dt))


def test_a_rigidly_moving_body_takes_the_garment_along_exactly():
    turned = about([1.0, 2.0, 0.5], 2.0).T
    held = frame(anchored(), posed(BODY, BODY.vertices @ turned + [0.3, 0.0, -1.0])).anchored
    np.testing.assert_allclose(held.target, MESH.vertices @ turned + [0.3, 0.0, -1.0], atol=1e-9)


def test_of_what_was_measured_only_the_top_is_held_and_only_along_itself():
    _, held = after(np.zeros(3), frames=1)
    top = GARMENT.hanging <= body_anchor.TOP
    np.testing.assert_array_equal(held.weight, np.where(FRONT & ~top, 0.0, 1.0))
    assert (held.variance[FRONT & top] > 1e3).all()
    wanted = CONFIG.slip_sd + CONFIG.slip_slope * GARMENT.hanging[FRONT & top]
    np.testing.assert_allclose(np.sqrt(held.tangential / PER_VERTEX)[FRONT & top], wanted, rtol=1e-6)


def shirt_after(slip, frames=90):
    """Anchor and pseudo-measurements of the sample's shirt, of which all but its left has slipped by so many metres."""
    garment, body = model.build(SHIRT), Mesh(SAMPLE.body_vertices[0], SAMPLE.body_faces)
    setup, normal = Setup(garment, contact.build(body, 0.1), Config()), np.empty_like(SHIRT.vertices)
    vertex_normals(SHIRT.vertices, garment.faces, normal)
    across = np.cross(normal, [0.0, 1.0, 0.0])
    slipped = SHIRT.vertices + slip * across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    under = contact.start(setup.body, SHIRT.vertices, Config().physics)
    anchor, seen = body_anchor.start(setup, body.vertices, SHIRT.vertices), SHIRT.vertices[:, 0] < 0.05
    for step in range(frames + 1):
        last = Track(None, None, None, 0.0, Health(), None, under, anchor)
        pose = contact.posed(setup.body, under, body.vertices)
        problem = body_anchor.measure(problem_of(garment, None, Config(), last=last, body=pose, dt=1 / FPS))
        if step < frames:
            anchor = body_anchor.learn(problem, slipped, seen)
    return anchor, problem.anchored, seen


def test_what_lies_on_the_shoulders_is_held_by_as_much_as_it_is_seen_to_slip():
    sizes = []
    for slip in (0.005, 0.04):
        anchor, held, seen = shirt_after(slip)
        assert not anchor.held.any()
        assert (held.weight[anchor.bound.contact.face >= 0] == 1.0).all()
        assert (held.variance[seen] > 1e3).all()  # along its normal the cloud alone measures
        sizes.append([np.sqrt(np.median(held.tangential[part])) for part in (seen, ~seen)])
    little, much = np.array(sizes)
    assert (much > 2.5 * little).all()
    assert little[0] > CONFIG.seen_slip * 0.8 * little[1]


def test_before_it_is_seen_what_lies_on_the_shoulders_slips_as_guessed():
    anchor, held, _ = shirt_after(0.04, frames=0)
    size = SHIRT.n_vertices / len(anchor.slip)
    np.testing.assert_allclose(held.tangential, size * anchor.slip[model.build(SHIRT).patch])


def test_the_place_on_a_body_that_is_wrong_is_as_uncertain():
    wrong = posed(BODY)._replace(intruded=(0.01**2, 1.0 - contact.FEW))
    known, held = (frame(anchored(), body).anchored for body in (posed(BODY), wrong))
    np.testing.assert_allclose(held.tangential - known.tangential, PER_VERTEX * 0.01**2)


def test_cloth_slips_on_the_body_the_more_the_farther_below_the_top_it_hangs():
    _, held = after(np.zeros(3), frames=0)
    below = MESH.vertices[:, 1].max() - MESH.vertices[:, 1]
    wanted = CONFIG.slip_sd + CONFIG.slip_slope * below
    np.testing.assert_allclose(np.sqrt(held.tangential / PER_VERTEX), wanted, atol=0.1 * CONFIG.slip_slope)  # a patch is so wide


def test_what_lies_on_the_shoulders_slips_there_and_a_waistband_or_a_cape_does_not():
    closed = ball(3)
    middle = closed.vertices[closed.faces].mean(axis=1)
    over, back = middle[:, 1] > -0.15, middle[:, 2] < 0.0
    config = Config(anchor=Anchor(slip_slope=0.0))
    slips = []
    for part in (over & back, over & (np.abs(middle[:, 0]) < 0.15)):  # a cape, and a shirt: closed in front, with holes for arms
        mesh, _ = Mesh.cleaned(closed.vertices, closed.faces[part])
        anchor = body_anchor.start(Setup(model.build(mesh), contact.build(BODY, 0.1), config), BODY.vertices, mesh.vertices)
        slips.append(np.sqrt(anchor.slip).tolist())
        assert not anchor.held.any()
    waist = body_anchor.start(Setup(GARMENT, contact.build(BODY, 0.1), config), BODY.vertices, MESH.vertices)
    assert waist.held.any()
    assert set(slips[0]) == set(np.sqrt(waist.slip)) == {CONFIG.slip_sd}
    assert set(slips[1]) == {CONFIG.shoulder_slip_sd}


def test_a_bag_and_a_skirt_with_a_loose_apron_hang_by_their_tops():
    closed, n = ball(3), MESH.n_vertices
    below = closed.vertices[closed.faces].mean(axis=1)[:, 1] < 0.02
    sock, _ = Mesh.cleaned(closed.vertices * [1.0, 2.0, 1.0], closed.faces[below])
    apron = sheet(4, 4, spacing=0.04)
    hanging = apron.vertices - apron.vertices.max(axis=0) + [0.0, MESH.vertices[:, 1].max() - 0.1, 0.4]
    loose = Mesh(np.concatenate([MESH.vertices, hanging]), np.concatenate([MESH.faces, apron.faces + n]))
    for mesh in (sock, loose):
        anchor = body_anchor.start(Setup(model.build(mesh), contact.build(BODY, 0.1), Config()), BODY.vertices, mesh.vertices)
        assert anchor.held.any()


@pytest.mark.parametrize("path", sorted(data.TRAINING.glob("*.npz")), ids=lambda path: path.stem)
def test_garments_are_told_by_where_they_hang(path):
    sequence = load_sequence(path)
    anchor = Config(anchor=Anchor(slip_slope=0.0))
    body = Mesh(sequence.body_vertices[0], sequence.body_faces)
    garment = model.build(Mesh(sequence.template, sequence.garment_faces))
    start = body_anchor.start(
        Setup(garment, contact.build(body, 0.1), anchor), body.vertices, np.asarray(sequence.garment_vertices[0], float)
    )
    waist = path.stem.startswith("skirt")
    assert set(np.sqrt(start.slip)) == {CONFIG.slip_sd if waist else CONFIG.shoulder_slip_sd}


def test_vertices_far_from_the_body_are_not_held():
    away = MESH.vertices + np.where(FRONT, 0.0, 1.0)[:, None] * [0.0, 0.0, -1.0]
    held = frame(anchored(away), posed(BODY)).anchored
    np.testing.assert_array_equal(held.weight, np.where(FRONT, 1.0, 0.0))


def test_nothing_is_held_while_the_body_is_not_known():
    known = anchored()
    unknown = frame(known, None, 0.1)
    assert unknown.anchored is None
    assert body_anchor.learn(unknown, MESH.vertices, FRONT) is known


def test_before_anything_is_seen_the_first_guess_stands():
    known, held = after(np.zeros(3), frames=0)
    np.testing.assert_allclose(held.variance, PER_VERTEX * known.guess[GARMENT.patch])


def test_the_first_guess_grows_with_the_distance_from_the_body_and_from_the_top():
    sizes = []
    for wider in (1.0, 1.05, 1.1, 3.0):
        along = np.sqrt(anchored(MESH.vertices * [wider, 1.0, wider]).guess)
        assert (along >= CONFIG.normal_sd).all()
        sizes.append(along.mean())
    assert (np.diff(sizes) > 0).all()
    below = (MESH.vertices[:, 1].max() - MESH.vertices[:, 1]).mean()
    far = CONFIG.normal_sd + CONFIG.clearance_slope * CONFIG.reach  # nothing is within reach
    np.testing.assert_allclose(sizes[-1], far + CONFIG.hanging_slope * below, rtol=0.1)


@pytest.mark.parametrize("times", [0.5, 3.0])
def test_what_is_not_seen_deviates_by_as_many_times_its_first_guess_as_what_is(times):
    wanted = times * np.sqrt(anchored().guess)[GARMENT.patch]
    _, held = after(wanted[:, None] * normals(MESH.vertices))
    np.testing.assert_allclose(np.sqrt(held.variance / PER_VERTEX)[~FRONT], wanted[~FRONT], rtol=0.2)


def test_a_garment_that_goes_with_its_body_is_held_to_it_and_no_more_closely_than_the_least():
    _, held = after(np.zeros(3), frames=300)
    assert (held.variance >= PER_VERTEX * CONFIG.least_sd**2 - 1e-15).all()
    assert held.variance[~FRONT].max() < PER_VERTEX * 0.02**2


def test_near_parts_count_most():
    left = MESH.vertices[:, 0] < 0
    deviation = np.where(left, 0.03, 0.0)[:, None] * normals(MESH.vertices)
    known, held = after(deviation)
    relative = held.variance / known.guess[GARMENT.patch]
    assert relative[left & ~FRONT].mean() > 1.5 * relative[~left & ~FRONT].mean()


def test_two_short_steps_are_one_long_one():
    deviation = 0.02 * normals(MESH.vertices)
    half, _ = after(deviation, 1, dt=0.03, start=after(deviation, 1, dt=0.02)[0])
    whole, _ = after(deviation, 1, dt=0.05)
    np.testing.assert_allclose(half.squares, whole.squares, atol=1e-12)
    np.testing.assert_allclose(half.seen, whole.seen)


# In the tracker --------------------------------------------------------------------------------------------------------


def hidden_error(swing, memory, frames=40):
    """RMS error (m) of the back of a garment seen from the front, on a body that leans and sways; ``swing`` (m) is how far the
    garment sways against it."""
    config = dataclasses.replace(Config(), anchor=Anchor(memory=memory))
    tracker, errors = Tracker(MESH, body=BODY, config=config), []
    height = MESH.vertices[:, 1:2] / MESH.vertices[:, 1].max()
    for k in range(frames):
        bend = about([1.0, 0.0, 0.3], 0.25 * np.sin(0.25 * k)).T
        shift = [0.03 * np.sin(0.2 * k), 0.0, 0.0]
        worn = 1.0 + 0.15 * np.sin(0.3 * k) * np.sin(6.0 * height)  # the body breathes: no rigid motion explains it
        body = (BODY.vertices * np.hstack([worn, np.ones_like(worn), worn])) @ bend + shift
        truth = (MESH.vertices * np.hstack([worn, np.ones_like(worn), worn])) @ bend + shift
        truth = truth + swing * np.sin(0.4 * k) * (1.0 - height) * [0.0, 0.0, 1.0]
        points = scan(truth, MESH, 4000, 0.003, seed=k)
        points = points[points[:, 2] > shift[2]]
        result = tracker.step(points, timestamp=k / FPS, sensor_origin=np.array([0.0, 0.2, 2.0]), body_vertices=body)
        errors.append(rms((result.vertices - truth)[~result.observed]))
    return float(np.mean(errors[frames // 2 :]))


def test_a_hidden_part_that_goes_with_the_body_follows_it_more_closely_for_being_held():
    assert hidden_error(0.0, CONFIG.memory) < 0.8 * hidden_error(0.0, 0.0)


def test_a_hidden_part_of_what_swings_freely_is_not_pinned():
    assert hidden_error(0.06, CONFIG.memory) < 1.1 * hidden_error(0.06, 0.0)


def test_a_garment_turns_with_its_waistband_where_the_cloud_does_not_show_it():
    """A round tube, of which no scan shows how it is turned, on a body whose upper end alone turns to and fro."""
    angle = np.arctan2(MESH.vertices[:, 2], MESH.vertices[:, 0])
    round_ = Mesh(np.column_stack([0.16 * np.cos(angle), MESH.vertices[:, 1], 0.16 * np.sin(angle)]), MESH.faces)
    body, errors = inner_body(round_, 0.95), []
    share = np.clip((body.vertices[:, 1] / body.vertices[:, 1].max() - 0.5) / 0.4, 0.0, 1.0)  # of the turn, up the body
    tracker = Tracker(round_, body=body)
    for k in range(1, 50):
        turned = 0.6 * np.sin(0.12 * k)
        truth = round_.vertices @ about([0.0, 1.0, 0.0], turned).T
        pose = np.stack([about([0.0, 1.0, 0.0], turned * s) @ v for s, v in zip(share, body.vertices, strict=True)])
        result = tracker.step(scan(truth, round_, 4000, 0.003, seed=k), timestamp=k / FPS, body_vertices=pose)
        errors.append(rms(result.vertices - truth))
    assert np.mean(errors) < 0.3 * 0.16 * 0.6 / np.sqrt(2)  # of how far it is turned
