"""Stage B, colour: registration of a textured sheet, whatever the light; nothing without texture or without colours."""

import numpy as np
import pytest

import ddakf
from ddakf.appearance.colour import LEAST_NOISE2
from ddakf.errors import InvalidFrame
from ddakf.evaluation.sensors.texture import Texture
from ddakf.kernels import colour as kernels
from ddakf.transfer import transferred

N, SPACING = 30, 0.02
X, Y = np.meshgrid(np.arange(N), np.arange(N), indexing="ij")
CORNER = (X[:-1, :-1] * N + Y[:-1, :-1]).ravel()
FACES = np.concatenate(
    [np.stack([CORNER, CORNER + N, CORNER + 1], axis=1), np.stack([CORNER + N, CORNER + N + 1, CORNER + 1], axis=1)]
)
SHEET = ddakf.Mesh(SPACING * np.stack([X.ravel(), Y.ravel(), 0.0 * X.ravel()], axis=1), FACES)
ORIGIN = np.array([0.3, 0.3, 2.0])
INNER = (np.abs(SHEET.vertices[:, :2] - 0.29) < 0.2).all(axis=1)
WIDE = 0.1  # m of plane around the sheet, without an end that a hem could find


def seen(texture: Texture | None, slid: np.ndarray, seed: int = 0, light: float = 1.0):
    """Points of a plane whose colours have slid (3,), and the colours; no point shows where the cloth is."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-WIDE, N * SPACING + WIDE, (12000, 2)), np.zeros(12000)])
    albedo = texture.albedo(points - slid)
    shade = light * (0.6 + 0.4 * np.sin(9.0 * points[:, :1]))  # of folds that stay where they are
    colors = 255 * (albedo * shade) ** (1 / 2.2) + 2.0 * rng.normal(size=albedo.shape)
    return (points + 0.001 * rng.normal(size=points.shape)).astype(np.float32), np.clip(np.rint(colors), 0, 255).astype(np.uint8)


def tracked(texture: Texture, frames: int = 12, step: float = 0.002, colours: bool = True) -> tuple[ddakf.Tracker, list]:
    """A tracker of the sheet that slides by ``step`` metres per frame along x after three frames, and its results."""
    tracker = ddakf.Tracker(SHEET)
    results = []
    for k in range(frames):
        slid = np.array([step * max(k - 2, 0), 0.0, 0.0])
        points, colors = seen(texture, slid, seed=k, light=1.0 - 0.02 * k)
        colors = colors if colours else None
        results.append(tracker.step(points, timestamp=k / 30, sensor_origin=ORIGIN, colors=colors))
    return tracker, results


def test_a_slide_that_only_colours_show_is_followed():
    slid = 0.002 * 9
    _, results = tracked(Texture("print"))
    _, blind = tracked(Texture("print"), colours=False)
    moved, stayed = (results[-1].vertices - SHEET.vertices)[INNER], (blind[-1].vertices - SHEET.vertices)[INNER]
    assert np.abs(moved[:, 0] - slid).mean() < 0.15 * slid
    assert np.abs(moved[:, 1]).mean() < 0.15 * slid
    assert np.abs(stayed[:, 0]).mean() < 0.7 * slid


def first_frame(start: np.ndarray, colours: bool) -> tuple[ddakf.Tracker, ddakf.FrameResult]:
    """A tracker that starts at (V, 3) and has seen the sheet's plane once. It takes the template's size for right."""
    tracker = ddakf.Tracker(SHEET, config=ddakf.Config.from_dict({"physics": {"size_memory": 0.0}}))
    tracker.reset(vertices=start)
    points, colors = seen(Texture("print"), np.zeros(3))
    return tracker, tracker.step(points, timestamp=0.0, sensor_origin=ORIGIN, colors=colors if colours else None)


def test_an_exact_start_that_strains_the_template_is_held_by_colours():
    start = np.array([0.0, 0.3, 0.0]) + np.array([1.0, 1.08, 1.0]) * (SHEET.vertices - [0.0, 0.3, 0.0])
    off = []
    for colours in (False, True):
        tracker, result = first_frame(start, colours)
        for k in range(1, 12):
            points, colors = seen(Texture("print"), np.zeros(3), seed=k)
            result = tracker.step(points, timestamp=k / 30, sensor_origin=ORIGIN, colors=colors if colours else None)
        off.append(np.sqrt(np.square(result.vertices - start)[INNER].sum(axis=1).mean()))
    assert off[1] < 0.25 * off[0]


def test_colours_are_learned_at_the_start_only_where_the_cloud_agrees_with_it():
    (exact, _), (off, _) = (first_frame(SHEET.vertices + [0.0, 0.0, away], True) for away in (0.0, 0.005))
    sure, doubtful = (np.sqrt(np.median(each._track.appearance.registered2[INNER])) for each in (exact, off))
    assert sure < 0.002
    assert doubtful > 2.0 * sure


def test_stripes_tell_nothing_along_themselves():
    _, results = tracked(Texture("stripes"), step=0.0)  # around y: they vary along y alone
    _, without = tracked(Texture("stripes"), step=0.0, colours=False)
    covariance, blind = results[-1].covariance[INNER], without[-1].covariance[INNER]
    assert np.median(covariance[:, 1, 1] / blind[:, 1, 1]) < 0.7
    assert np.median(covariance[:, 0, 0] / blind[:, 0, 0]) > 0.85


def test_a_garment_without_texture_is_tracked_as_without_colours():
    _, with_colours = tracked(Texture("plain"))
    _, without = tracked(Texture("plain"), colours=False)
    apart = np.abs(with_colours[-1].vertices - without[-1].vertices)[INNER]
    assert apart.max() < 1e-3


def test_frames_without_colours_leave_what_was_learned_and_change_nothing_else():
    tracker, _ = tracked(Texture("print"), frames=5)
    learned = tracker._track.appearance
    points, _ = seen(Texture("print"), np.zeros(3), seed=9)
    tracker.step(points, timestamp=1.0, sensor_origin=ORIGIN)
    assert tracker._track.appearance is learned


def test_a_snapshot_goes_on_to_the_bit():
    tracker, _ = tracked(Texture("print"), frames=5)
    other = ddakf.Tracker.restore(tracker.snapshot())
    points, colors = seen(Texture("print"), np.zeros(3), seed=9)
    a, b = (each.step(points, timestamp=1.0, sensor_origin=ORIGIN, colors=colors) for each in (tracker, other))
    assert np.array_equal(a.vertices, b.vertices)
    assert np.array_equal(a.covariance, b.covariance)
    assert all(np.array_equal(*pair) for pair in zip(tracker._track.appearance, other._track.appearance, strict=True))


@pytest.mark.slow
def test_colours_without_noise_stay_measurements_with_some():
    """As those of a grey camera, of which each channel is the same."""
    tracker, grey = ddakf.Tracker(SHEET), None
    for k in range(60):
        points, colors = seen(Texture("print"), np.zeros(3), seed=k)
        grey = np.repeat(colors[:, :1], 3, axis=1)
        tracker.step(points, timestamp=k / 30, sensor_origin=ORIGIN, colors=grey)
    assert (tracker._track.appearance.noise2 == LEAST_NOISE2).all()
    restored = ddakf.Tracker.restore(tracker.snapshot())
    result = restored.step(points, timestamp=9.0, sensor_origin=ORIGIN, colors=colors)
    assert np.isfinite(result.covariance).all()
    earlier = tracker._track.appearance._replace(noise2=np.full(2, 1e-20))  # of a version that had no least
    tracker._track = tracker._track._replace(appearance=earlier)
    assert (ddakf.Tracker.restore(tracker.snapshot())._track.appearance.noise2 == LEAST_NOISE2).all()


def test_an_appearance_goes_to_another_mesh():
    tracker, _ = tracked(Texture("print"), frames=8, step=0.0)
    finer = ddakf.Config(discretisation=ddakf.config.Discretisation(working_edge=0.015, working_finest=10.0))
    other = tracker.configured(finer)
    assert other.working_vertices != tracker.working_vertices
    a, b = tracker._track.appearance, other._track.appearance
    assert b.mean.shape[0] == other.working_vertices
    middle = kernels.SIDE // 2
    place = other._working.mesh.vertices
    nearest = np.square(place[:, None] - SHEET.vertices).sum(axis=2).argmin(axis=1)
    known = (b.weight[:, middle, middle] > 0) & (np.linalg.norm(place - SHEET.vertices[nearest], axis=1) < 0.004)
    apart = b.mean[known, middle, middle] - a.mean[nearest[known], middle, middle]
    assert known.sum() > 50
    assert np.sqrt(np.square(apart).mean()) < 0.3 * a.mean[:, middle, middle].std()
    same = tracker._discretised
    again = transferred(tracker._track, same, same).appearance
    assert np.allclose(again.mean, a.mean * (again.weight > 0)[..., None], atol=1e-5)


def test_the_information_of_a_slide_is_that_of_a_dense_sum():
    tracker, _ = tracked(Texture("print"), frames=8, step=0.0)
    appearance, config = tracker._track.appearance, tracker.config.colour
    v = int(np.flatnonzero(INNER)[0])
    inverse, found, x = np.empty((kernels.SIDE, kernels.SIDE)), np.empty((3, 2)), np.array([1.3, 2.6])
    kernels.variances_of_texels(appearance.weight[v], 1.0, inverse)
    kernels.look_up(appearance.mean[v], inverse, *x, config.texel, found)
    value = lambda u, w: np.array(  # noqa: E731, bilinear
        sum(
            (u - 1 if a else 2 - u) * (w - 2 if b else 3 - w) * appearance.mean[v, 1 + a, 2 + b].astype(float)
            for a in (0, 1)
            for b in (0, 1)
        )
    )
    assert np.allclose(found[0], value(*x))
    assert np.allclose(found[1], (value(1.5, 2.6) - value(1.1, 2.6)) / (0.4 * config.texel), atol=1e-3)
    assert np.allclose(found[2], (value(1.3, 2.8) - value(1.3, 2.4)) / (0.4 * config.texel), atol=1e-3)


@pytest.mark.parametrize(
    "colors", [np.zeros((3, 3), np.uint8), np.zeros((4, 4), np.uint8), np.zeros((4, 3)), np.zeros(12, np.uint8)]
)
def test_colours_of_another_shape_or_type_are_refused(colors):
    tracker = ddakf.Tracker(SHEET)
    with pytest.raises(InvalidFrame, match="colors"):
        tracker.step(np.zeros((4, 3)), timestamp=0.0, colors=colors)


def test_shading_does_not_change_a_chromaticity():
    bright = np.array([[200, 120, 60]], float)
    dim = np.rint(0.6 * bright)
    channels = [np.empty((2, 1), np.float32), np.empty((2, 1), np.float32)]
    for value, out in zip((bright, dim), channels, strict=True):
        kernels.log_chromaticities(value.astype(np.uint8), np.zeros(1, np.int32), kernels.LOGARITHM, out)
    assert np.abs(channels[0] - channels[1]).max() < 0.1 * np.abs(channels[0]).max()
