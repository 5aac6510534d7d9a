"""Pictures: contents have the right places and colours; animations keep the true speed."""

import builtins

import numpy as np
import pytest
from PIL import Image

from ddakf.data import sample
from ddakf.errors import InvalidArgument, MissingDependency
from ddakf.evaluation.drawing import pictures
from ddakf.evaluation.drawing.pictures import Painter, Shot
from ddakf.evaluation.sensors.virtual_sensor import Sensor
from ddakf.files.depth import Intrinsics as Lens
from ddakf.kernels import zbuffer


@pytest.fixture(scope="module")
def recording():
    sequence, rng = sample(), np.random.default_rng(0)
    shots = []
    for frame in range(0, 150, 50):
        cloud = Sensor("front").capture(sequence, frame, rng)
        vertices = sequence.garment_vertices[frame]
        sigma = np.where(vertices[:, 2] > vertices[:, 2].mean(), 0.002, 0.019)
        shots.append(Shot(cloud.points, vertices, sigma, f"frame {frame}", sequence.body_vertices[frame]))
    return sequence, shots


def _panel(picture, number):
    left = pictures.GAP + number * (pictures.PANEL_WIDTH + pictures.GAP)
    top = pictures.HEADER
    box = (left, top, left + pictures.PANEL_WIDTH, top + pictures.PANEL_HEIGHT)
    return np.asarray(picture.crop(box), float)


def _share(panel, colour, tolerance=40):
    return (np.abs(panel - colour).sum(axis=2) < tolerance).mean()


def test_each_panel_shows_what_its_heading_says(recording):
    sequence, shots = recording
    painter = Painter(shots, sequence.garment_faces, sequence.body_faces, title="test")
    picture = painter.paint(shots[0])
    cloud, front, behind = (_panel(picture, k) for k in range(3))
    certain, uncertain = (pictures.colours(np.array([mm]), painter.scale_mm)[0] for mm in (2, 19))
    assert painter.scale_mm == 20
    assert _share(cloud, pictures.POINT) > 10 * _share(behind, pictures.POINT)
    assert _share(cloud, pictures.BODY) > 0.05
    assert _share(front, certain) > 0.1 > 0.01 > _share(front, uncertain)
    assert _share(behind, uncertain) > 0.1


def test_the_view_follows_the_sensor(recording):
    sequence, shots = recording
    painter = Painter(shots, sequence.garment_faces, title="test", sensor_origin=np.array([0.0, 1.0, -3.0]))
    front = _panel(painter.paint(shots[0]), 1)
    assert _share(front, pictures.colours(np.array([19.0]), painter.scale_mm)[0]) > 0.1


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_animations_have_all_frames_at_their_speed_and_are_small(recording, tmp_path, suffix):
    sequence, shots = recording
    painter = Painter(shots, sequence.garment_faces, sequence.body_faces, title="test")
    pictures.save_animation(tmp_path / f"a{suffix}", painter, shots, fps=10)
    with Image.open(tmp_path / f"a{suffix}") as animation:
        assert animation.n_frames == 3
        animation.seek(1)
        animation.load()
        assert animation.info["duration"] == 100
        assert 640 <= animation.width <= 760
    assert (tmp_path / f"a{suffix}").stat().st_size < 3 * 80_000


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_the_scale_of_an_animation_has_all_its_colours(recording, tmp_path, suffix):
    sequence, shots = recording
    rare = np.where(np.arange(len(shots[0].vertices)) < 40, 0.02, 0.004)  # hardly any vertex is as uncertain as the scale's end
    shots = [Shot(shot.points, shot.vertices, rare, shot.caption, shot.body) for shot in shots]
    painter = Painter(shots, sequence.garment_faces, sequence.body_faces, title="test")
    pictures.save_animation(tmp_path / f"a{suffix}", painter, shots, fps=10)
    with Image.open(tmp_path / f"a{suffix}") as animation:
        row = np.asarray(animation.convert("RGB"), float)[pictures.HEADER + pictures.PANEL_HEIGHT + 24]
    left, right = len(row) // 2 + 60, len(row) - 24
    true = pictures.colours(np.linspace(0, 1, right - left, endpoint=False), 1)
    assert np.abs(row[left:right] - true).max(axis=1)[4:-4].max() < 40


def test_a_still_without_points_and_body(recording, tmp_path):
    sequence, shots = recording
    shot = Shot(np.zeros((0, 3)), shots[0].vertices, shots[0].sigma, "empty")
    pictures.save_still(tmp_path / "folder" / "p.png", Painter([shot], sequence.garment_faces, title="t"), shot)
    assert (tmp_path / "folder" / "p.png").stat().st_size > 1000


def test_errors_are_sentences(recording, tmp_path, monkeypatch):
    sequence, shots = recording
    painter = Painter(shots[:1], sequence.garment_faces, title="t")
    with pytest.raises(InvalidArgument, match=r"\.webp"):
        pictures.save_animation(tmp_path / "a.mp4", painter, shots, 30)
    with pytest.raises(InvalidArgument, match="Pillow can write"):
        pictures.save_still(tmp_path / "a.nothing", painter, shots[0])
    with pytest.raises(InvalidArgument, match="at least one frame"):
        Painter([], sequence.garment_faces, title="t")

    def refuse(name, *rest, original=builtins.__import__):
        if name.startswith("PIL"):
            raise ModuleNotFoundError(name)
        return original(name, *rest)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(MissingDependency, match="pillow"):
        painter.paint(shots[0])


def test_colours_are_the_ends_of_viridis_and_saturate():
    ends = pictures.colours(np.array([0.0, 10, 99, -1]), 10)
    assert np.array_equal(ends, pictures.COLOURS[[0, -1, -1, 0]])


def test_interpolation_is_perspective_correct():
    vertices = np.array([[-1, -1, 2], [2, -1, 4], [-1, 2, 3]], float)
    faces, lens = np.array([[0, 1, 2]]), Lens(20.0, 21.0, 11.5, 8.0)
    depth, face = np.full((18, 24), np.inf), np.full((18, 24), -1, np.int32)
    zbuffer.rasterize(vertices, faces, lens, 5, depth, face)
    image = np.zeros((18, 24, 3))
    zbuffer.interpolate(vertices, faces, vertices, lens, 5, face, image)  # interpolating positions gives the position
    hit = face == 5
    v, u = np.nonzero(hit)
    z = depth[hit]
    expected = np.column_stack([(u - 11.5) / 20 * z, (v - 8) / 21 * z, z])
    assert hit.sum() > 20
    assert np.allclose(image[hit], expected)
    assert not image[~hit].any()
