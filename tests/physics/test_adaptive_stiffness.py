"""Adaptive stiffness: it follows the strain that a garment's own estimates show."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddakf import Config, Mesh, Tracker
from ddakf.garment import model
from ddakf.physics import adaptive_stiffness
from ddakf.physics.adaptive_stiffness import adapted, initial
from ddakf.stages import fuse
from ddakf.types import Track
from tests.physics.shapes import sheet
from tests.stages.scenes import FPS, about, problem_of, scan, tube

MESH = sheet(9, 9)
GARMENT = model.build(MESH)
EVERYWHERE = np.ones(MESH.n_vertices, bool)
CONFIG = Config()
NUMBERS = CONFIG.physics
STIFF = dataclasses.replace(CONFIG, physics=dataclasses.replace(NUMBERS, strain_followed=0.0))


def strained(mesh, by):
    """Every face's plane scaled by 1 + ``by`` in all directions: strain ``by`` along warp and weft, no shear."""
    return mesh.vertices * (1 + by)


def after(position, frames=100, dt=0.1, measured=EVERYWHERE, start=None):
    known = initial(NUMBERS) if start is None else start
    for _ in range(frames):
        last = Track(None, None, None, known, None, None, None, None)
        known = adaptive_stiffness.learn(problem_of(GARMENT, None, CONFIG, last=last, dt=dt), position, measured)
    return known


def test_a_garment_that_keeps_its_metric_stays_as_stiff_as_it_is_said_to_be():
    for learned in (initial(NUMBERS), after(MESH.vertices)):
        assert adapted(learned, CONFIG) == STIFF


@given(by=st.floats(-0.3, 0.3))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_an_even_strain_is_learned_exactly(by):
    assert after(strained(MESH, by)) == pytest.approx(2 * by**2, abs=1e-9)


@given(seed=st.integers(0, 2**32 - 1), angle=st.floats(0, 3))
@settings(max_examples=15, deadline=None, derandomize=True)
def test_rigid_motion_is_no_strain(seed, angle):
    rng = np.random.default_rng(seed)
    position = MESH.vertices + rng.normal(scale=0.002, size=MESH.vertices.shape)
    moved = position @ about(rng.normal(size=3), angle).T + rng.normal(size=3)
    assert after(moved) == pytest.approx(after(position), rel=1e-6)


def test_two_short_steps_are_one_long_one():
    position = strained(MESH, 0.1)
    half = after(position, 1, 0.02, start=after(position, 1, 0.03))
    assert half == pytest.approx(after(position, 1, 0.05))
    assert NUMBERS.strain_sd**2 < half < after(position)


def test_the_first_frame_after_a_gap_says_no_more_than_another():
    position = strained(MESH, 0.1)
    assert after(position, 1, dt=30.0) == after(position, 1, dt=0.1)


def test_only_measured_faces_count():
    position = MESH.vertices.copy()
    far = position[:, 0] > np.quantile(position[:, 0], 0.7)
    position[far] += 0.5 * (position[far] - position[far].mean(axis=0))
    assert adapted(after(position, measured=~far), CONFIG) == STIFF


@pytest.mark.parametrize("share", [0.0, 0.2, 0.45])
def test_less_than_half_of_a_garment_says_nothing_about_its_strain(share):
    start, seen = 0.01, MESH.vertices[:, 0] < np.quantile(MESH.vertices[:, 0], share)
    for position in (MESH.vertices, strained(MESH, 0.2)):
        assert after(position, measured=seen, start=start) is start


@given(variances=st.lists(st.floats(0, 10), min_size=2, max_size=2))
@settings(max_examples=30, deadline=None, derandomize=True)
def test_the_more_it_strains_the_softer_it_is_and_the_more_only_uneven_strain_is_resisted(variances):
    low, high = (adapted(v, CONFIG).physics for v in sorted(variances))
    for name in ("stretch", "shear"):
        whole = getattr(NUMBERS, name)
        assert whole >= getattr(low, name) >= getattr(high, name) >= NUMBERS.softest * whole
    assert 0 <= low.strain_followed <= high.strain_followed <= NUMBERS.strain_followed
    assert NUMBERS.rest_rigidity <= low.rest_rigidity <= high.rest_rigidity <= NUMBERS.uneven_rigidity
    names = ("stretch", "shear", "rest_rigidity", "strain_followed")
    assert dataclasses.replace(high, **{name: getattr(NUMBERS, name) for name in names}) == NUMBERS


def test_the_papers_preset_never_softens():
    paper = Config.paper()
    stiff = adapted(after(strained(MESH, 0.5), start=initial(paper.physics)), paper).physics
    assert (stiff.stretch, stiff.shear) == (paper.physics.stretch, paper.physics.shear)


def widening(k):
    """A tube that grows to a tenth more girth in a second, and stays."""
    return TUBE.vertices * [1 + min(k, 30) / 300, 1.0, 1 + min(k, 30) / 300]


TUBE = tube()


def followed(config):
    tracker, errors = Tracker(Mesh(TUBE.vertices, TUBE.faces), config=config), []
    for k in range(45):
        true = widening(k)
        result = tracker.step(scan(true, TUBE, 3000, 0.002, seed=k), timestamp=k / FPS)
        errors.append(np.sqrt(np.mean(np.sum((result.vertices - true) ** 2, axis=1))))
    return tracker, float(np.mean(errors[30:]))


def test_a_garment_that_stretches_is_learned_and_followed_better_and_a_reset_forgets_it():
    of_one_size = dataclasses.replace(NUMBERS, size_memory=0.0)
    stiff = dataclasses.replace(CONFIG, physics=dataclasses.replace(of_one_size, strain_sd=1e3))
    tracker, error = followed(dataclasses.replace(CONFIG, physics=of_one_size))
    assert tracker._track.strain2 > 4 * NUMBERS.strain_sd**2
    assert error < 0.7 * followed(stiff)[1]
    again = Tracker.restore(tracker.snapshot())
    assert again._track.strain2 == tracker._track.strain2
    tracker.reset()
    assert tracker._track.strain2 == initial(NUMBERS)


def test_a_frame_whose_fit_is_thrown_away_teaches_nothing(monkeypatch):
    tracker, wide = Tracker(Mesh(TUBE.vertices, TUBE.faces)), TUBE.vertices * [1.1, 1.0, 1.1]
    for k in range(2):
        tracker.step(scan(wide, TUBE, 3000, 0.002, seed=k), timestamp=k / FPS)
    before = tracker._track.strain2
    with monkeypatch.context() as broken:
        broken.setattr(fuse, "solve", lambda system, *_: np.full((len(system.D), 4), np.nan, np.float32))
        tracker.step(scan(wide, TUBE, 3000, 0.002, seed=2), timestamp=2 / FPS)
    assert tracker._track.strain2 == before
    tracker.step(scan(wide, TUBE, 3000, 0.002, seed=3), timestamp=3 / FPS)
    assert tracker._track.strain2 != before
