"""Segmentation by colour: a sheet of cloth that lies on a larger plane of another colour."""

import dataclasses

import numpy as np
import pytest

import ddakf
from ddakf.appearance import segmentation
from ddakf.errors import InvalidSnapshot
from ddakf.kernels import segmentation as kernels
from ddakf.kernels.colour import LOGARITHM
from ddakf.transfer import transferred
from tests.appearance.test_colour import ORIGIN, SHEET, SPACING, N

CLOTH, SKIN = (40, 70, 120), (200, 150, 130)
SIDE, AROUND = (N - 1) * SPACING, 0.2  # m: of the sheet, and of the plane around it


def seen(cloth=CLOTH, around=SKIN, seed: int = 0, light: float = 1.0, band: float = 0.0):
    """Points of the plane, their colours, and whether they are on the sheet, whose outer ``band`` metres look like the plane."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-AROUND, SIDE + AROUND, (12000, 2)), np.zeros(12000)])
    inside = np.minimum(points[:, :2], SIDE - points[:, :2]).min(axis=1)
    albedo = np.where(inside[:, None] > band, cloth, around)
    colors = np.clip(np.rint(light * albedo + 3.0 * rng.normal(size=albedo.shape)), 0, 255).astype(np.uint8)
    return (points + 0.001 * rng.normal(size=points.shape)).astype(np.float32), colors, inside > 0.0


def kept(monkeypatch, tracker: ddakf.Tracker, points: np.ndarray, colors: np.ndarray | None, timestamp: float) -> np.ndarray:
    """(N,) bool: the points of the frame that a step does not leave out."""
    found = []

    def recorded(frame, problem):
        found.append(without_others(frame, problem))
        return found[-1]

    without_others = segmentation.without_others
    with monkeypatch.context() as patched:
        patched.setattr(segmentation, "without_others", recorded)
        tracker.step(points, timestamp=timestamp, sensor_origin=ORIGIN, colors=colors)
    rows = {row.tobytes() for row in found[0].points}
    return np.array([row.tobytes() in rows for row in points])


@pytest.mark.parametrize("light", [1.0, 0.8])
def test_what_lies_around_the_cloth_is_left_out_from_the_first_frame_on(monkeypatch, light):
    tracker = ddakf.Tracker(SHEET)
    for k in range(3):
        points, colors, cloth = seen(seed=k, light=light**k)
        stays = kept(monkeypatch, tracker, points, colors, k / 30)
        assert stays[cloth].mean() > 0.99
        assert stays[~cloth].mean() < 0.03


def test_cloth_that_is_surrounded_is_known_to_its_edge():
    error = {}
    for colours in (True, False):
        tracker = ddakf.Tracker(SHEET)
        tracker.reset(vertices=SHEET.vertices + [0.02, 0.0, 0.0])
        for k in range(20):
            points, colors, _ = seen(seed=k)
            result = tracker.step(points, timestamp=k / 30, sensor_origin=ORIGIN, colors=colors if colours else None)
        error[colours] = np.linalg.norm(result.vertices - SHEET.vertices, axis=1).mean()
    assert error[True] < 0.25 * error[False]


def test_a_garment_that_reappears_elsewhere_is_sought_in_its_colours():
    error = {}
    for colours in (True, False):
        tracker = ddakf.Tracker(SHEET)
        for k in range(40):
            points, colors, _ = seen(seed=k)
            shift = np.float32([0.1, 0.1, 0.0] if k >= 30 else [0.0, 0.0, 0.0])
            if 5 <= k < 30:
                points, colors = points[:0], colors[:0]
            how = {"sensor_origin": ORIGIN + shift, "colors": colors if colours else None}
            result = tracker.step(points + shift, timestamp=k / 30, **how)
        error[colours] = np.linalg.norm(result.vertices - SHEET.vertices - shift, axis=1).mean()
    assert error[True] < 0.005 < error[False]


@pytest.mark.parametrize(("around", "told"), [(SKIN, False), (CLOTH, True), (None, True)], ids=["unlike", "alike", "none"])
def test_a_whole_person_is_told_unless_its_colours_tell_it_apart(around, told):
    tracker = ddakf.Tracker(SHEET)
    for k in range(12):
        points, colors, _ = seen(around=around or SKIN, seed=k)
        result = tracker.step(points, timestamp=k / 30, sensor_origin=ORIGIN, colors=colors if around else None)
    assert ("whole_person" in [warning.code for warning in result.warnings]) == told


@pytest.mark.parametrize("around", [CLOTH, None], ids=["alike", "without colours"])
def test_all_points_stay_where_colours_tell_nothing(monkeypatch, around):
    tracker = ddakf.Tracker(SHEET)
    for k in range(3):
        points, colors, _ = seen(around=around or SKIN, seed=k)
        assert kept(monkeypatch, tracker, points, colors if around else None, k / 30).all()


def test_nothing_is_learned_nor_left_out_without_points_to_learn_from(monkeypatch):
    config = ddakf.Config.from_dict({"segmentation": {"points": 0}})
    tracker = ddakf.Tracker(SHEET, config=config)
    points, colors, _ = seen()
    assert kept(monkeypatch, tracker, points, colors, 0.0).all()
    assert tracker._track.palette is None
    assert ddakf.Config.paper().segmentation.points == 0


def test_an_edge_of_the_cloth_in_the_colour_of_what_is_around_stays(monkeypatch):
    tracker = ddakf.Tracker(SHEET)
    for k in range(5):
        points, colors, cloth = seen(seed=k, band=0.06)
        stays = kept(monkeypatch, tracker, points, colors, k / 30)
        assert stays[cloth].mean() > 0.97


def test_a_doubtful_frame_teaches_nothing():
    tracker = ddakf.Tracker(SHEET, config=ddakf.Config.from_dict({"segmentation": {"learned_above": 1.0}}))
    points, colors, _ = seen()
    tracker.step(points, timestamp=0.0, sensor_origin=ORIGIN, colors=colors)
    assert tracker._track.palette is None


@pytest.mark.slow
def test_what_was_learned_fades():
    tracker = ddakf.Tracker(SHEET)
    for k, cloth in enumerate([CLOTH] + 150 * [(120, 40, 40)]):
        points, colors, _ = seen(cloth=cloth, seed=k)
        tracker.step(points, timestamp=k / 30, sensor_origin=ORIGIN, colors=colors)
    here, before = (at(tracker, (120, 40, 40)), at(tracker, CLOTH))
    assert here > 50.0 * before


def at(tracker: ddakf.Tracker, color: tuple[int, int, int]) -> float:
    """Learned points of the garment in a colour."""
    cell = kernels.cell_of(np.array([color], np.uint8), 0, LOGARITHM)
    return float(tracker._track.palette.counts[segmentation.CLOTH][cell])


def test_a_histogram_holds_as_many_points_as_were_added():
    colors = np.random.default_rng(0).integers(0, 256, (5000, 3)).astype(np.uint8)
    counts, chosen = np.zeros(kernels.CELLS, np.float32), np.arange(5000) % 2 == 0
    kernels.add_colors(colors, chosen, LOGARITHM, counts)
    assert counts.sum() == pytest.approx(2500, rel=1e-4)


@pytest.mark.parametrize("value", [0, 255])
def test_every_colour_has_a_cell(value):
    for color in ((value, 128, 128), (128, value, 128), (128, 128, value), (value, value, value)):
        cell = kernels.cell_of(np.array([color], np.uint8), 0, LOGARITHM)
        assert all(0 <= c < n for c, n in zip(cell, kernels.CELLS, strict=True))


def learned_tracker() -> ddakf.Tracker:
    tracker = ddakf.Tracker(SHEET)
    for k in range(3):
        points, colors, _ = seen(seed=k)
        tracker.step(points, timestamp=k / 30, sensor_origin=ORIGIN, colors=colors)
    return tracker


def test_snapshots_keep_the_palette():
    tracker = learned_tracker()
    other = ddakf.Tracker.restore(tracker.snapshot())
    points, colors, _ = seen(seed=9)
    one, two = (t.step(points, timestamp=1 / 3, sensor_origin=ORIGIN, colors=colors) for t in (tracker, other))
    assert (one.vertices == two.vertices).all()
    for mine, theirs in zip(tracker._track.palette, other._track.palette, strict=True):
        assert (mine == theirs).all()


@pytest.mark.parametrize("field", ["counts", "alike", "seen"])
@pytest.mark.parametrize("damage", ["negative", "shape", "kind"])
def test_a_snapshot_with_a_damaged_palette_is_refused(field, damage):
    tracker = learned_tracker()
    palette = tracker._track.palette
    array = getattr(palette, field).copy()
    match damage:
        case "negative":
            array.flat[0] = -1.0
        case "shape":
            array = array[:-1]
        case "kind":
            array = array.astype(np.float64)
    tracker._track = tracker._track._replace(palette=palette._replace(**{field: array}))
    with pytest.raises(InvalidSnapshot, match=f"snapshot.palette_{field}"):
        ddakf.Tracker.restore(tracker.snapshot())


def test_the_palette_goes_along_to_another_working_mesh():
    tracker = learned_tracker()
    coarse = dataclasses.replace(tracker.config.discretisation, working_edge=0.04, working_vertices_least=50)
    other = ddakf.Tracker(SHEET, config=dataclasses.replace(tracker.config, discretisation=coarse))
    moved = transferred(tracker._track, tracker._discretised, other._discretised).palette
    assert other.working_vertices < tracker.working_vertices
    assert (moved.counts == tracker._track.palette.counts).all()
    assert moved.seen.shape == (other.working_vertices,)
    assert (moved.alike <= moved.seen + 1e-6).all()


def test_after_a_change_of_the_light_all_is_learned_anew(monkeypatch):
    tracker = ddakf.Tracker(SHEET)
    for k in range(12):
        points, colors, cloth = seen(cloth=(200, 200, 200), around=(60, 60, 60), seed=k, light=0.3 if k >= 6 else 1.0)
        stays = kept(monkeypatch, tracker, points, colors, k / 30)
        if k > 6:  # cloth has the colour that the plane had before
            assert stays[cloth].mean() > 0.99
            assert stays[~cloth].mean() < 0.03


def test_a_frame_of_other_things_alone_has_no_points_left():
    eyes = np.array([[0.3, 0.3, 2.0], [0.3, 0.3, 2.1]])
    tracker = ddakf.Tracker(SHEET)
    for k in range(4):
        points, colors, _ = seen(seed=k)
        colors = np.full_like(colors, SKIN) if k == 3 else colors
        origin = eyes[np.arange(len(points)) % 2]
        result = tracker.step(points, timestamp=k / 30, sensor_origin=origin, colors=colors)
    assert result.coverage == 0.0
    assert np.isfinite(result.vertices).all()


def test_what_was_learned_is_not_used_once_it_is_switched_off(monkeypatch):
    tracker = learned_tracker().configured(ddakf.Config.from_dict({"segmentation": {"points": 0}}))
    points, colors, _ = seen(seed=9)
    assert kept(monkeypatch, tracker, points, colors, 1 / 3).all()
    assert tracker._track.palette is None


def test_a_large_cloud_teaches_the_garment_as_much_as_a_small_one():
    learned = []
    for around in (2, 40):
        tracker = ddakf.Tracker(SHEET)
        for k in range(5):
            points, colors, _ = seen(seed=k)
            far = np.random.default_rng(k).uniform(1.0, 3.0, (6000 * around, 3)).astype(np.float32)
            points, colors = np.concatenate([far, points]), np.concatenate([np.full((len(far), 3), SKIN, np.uint8), colors])
            tracker.step(points, timestamp=k / 30, sensor_origin=ORIGIN, colors=colors)
        learned.append(tracker._track.palette.counts.sum(axis=(1, 2, 3)))
    assert learned[0] == pytest.approx(learned[1], rel=0.05)
