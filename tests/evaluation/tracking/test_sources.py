"""Sources: frames hold the tracker's input and the truth; a range has the same clouds as the whole."""

import numpy as np
import pytest

import ddakf
from ddakf.data import SAMPLE, sample
from ddakf.errors import InvalidArgument, InvalidFile
from ddakf.evaluation.datasets import open_dataset
from ddakf.evaluation.sensors.virtual_sensor import Sensor
from ddakf.evaluation.tracking import replay
from ddakf.evaluation.tracking.sources import chosen_frames, source_of
from ddakf.files import io


@pytest.mark.parametrize(
    ("text", "expected"),
    [(":", range(10)), ("2:5", range(2, 5)), ("7:", range(7, 10)), (":-8", range(2)), ("1:10", range(1, 10))],
)
def test_ranges_follow_the_rules_of_slices(text, expected):
    assert chosen_frames(text, 10) == expected


@pytest.mark.parametrize("text", ["", "3", "a:b", "4:5", "5:4", "1:2:3", "1:11", ":99"])
def test_ranges_that_are_none(text):
    with pytest.raises(InvalidArgument, match="frames"):
        chosen_frames(text, 10)


def test_started_at_the_truth_the_first_frame_is_given_away():
    source, sequence = source_of(open_dataset(SAMPLE), frames="3:6"), sample()
    frames = list(source)
    assert [frame.number for frame in frames] == [4, 5]
    assert len(source) == 2
    assert np.array_equal(source.start, sequence.garment_vertices[3])
    assert np.array_equal(source.garment.vertices, sequence.garment_rest)
    assert np.array_equal(frames[0].truth, sequence.garment_vertices[4])
    assert frames[1].timestamp == pytest.approx(5 / 30)
    assert frames[0].sensor_origin.shape == (3,)


def test_other_starts_track_every_frame():
    for start in ("rest", "search"):
        source = source_of(open_dataset(SAMPLE), frames="0:2", start=start)
        assert [frame.number for frame in source] == [0, 1]
        assert source.start is None


def test_a_search_begins_with_the_same_shape_somewhere_else():
    rest, search, other = (
        source_of(open_dataset(SAMPLE), start=start, seed=seed).garment
        for start, seed in (("rest", 1), ("search", 1), ("search", 2))
    )
    edge_lengths = [np.diff(mesh.vertices[mesh.edges], axis=1) for mesh in (rest, search)]
    assert np.allclose(*(np.linalg.norm(edges, axis=2) for edges in edge_lengths), atol=1e-6)
    assert np.linalg.norm(search.vertices - rest.vertices, axis=1).mean() > 0.2
    assert np.allclose(search.vertices[:, 1], rest.vertices[:, 1])
    assert not np.allclose(search.vertices, other.vertices)


def test_the_body_is_for_the_picture_and_for_the_tracker_only_when_told():
    kept, given = (source_of(open_dataset(SAMPLE), frames="0:2", give_body=give) for give in (False, True))
    assert kept.body is None
    assert next(iter(kept)).body_vertices is None
    assert next(iter(kept)).body is not None
    assert np.array_equal(given.body.vertices, sample().body_vertices[0])
    assert np.array_equal(next(iter(given)).body_vertices, sample().body_vertices[1])


def test_a_range_sees_what_the_whole_sees_and_seeds_differ():
    sensor = Sensor("ring4", points=500)
    whole = list(source_of(open_dataset(SAMPLE), sensor, frames="0:4"))
    part = list(source_of(open_dataset(SAMPLE), sensor, frames="2:4"))
    other = list(source_of(open_dataset(SAMPLE), sensor, frames="2:4", seed=2))
    assert np.array_equal(whole[-1].points, part[0].points)
    assert not np.array_equal(part[0].points, other[0].points)


def test_a_slower_sensor_sees_the_same_in_the_frames_that_it_takes():
    whole = list(source_of(open_dataset(SAMPLE), Sensor(points=500), frames="0:8"))
    slow = source_of(open_dataset(SAMPLE), Sensor(points=500, every=3), frames="0:8")
    frames = list(slow)
    assert [frame.number for frame in frames] == [3, 6]
    assert len(slow) == 2
    assert slow.fps == pytest.approx(sample().fps / 3)
    assert frames[0].timestamp == whole[2].timestamp
    assert np.array_equal(frames[1].points, whole[5].points)


def test_without_a_rest_shape_the_first_chosen_frame_is_the_template(tmp_path):
    s = sample()
    np.savez(tmp_path / "s.npz", garment_V=s.garment_vertices[:5], garment_F=s.garment_faces, fps=30)
    source = source_of(open_dataset(tmp_path / "s.npz"), frames="2:5")
    assert np.array_equal(source.garment.vertices, s.garment_vertices[2])
    with pytest.raises(InvalidArgument, match="body"):
        source_of(open_dataset(tmp_path / "s.npz"), give_body=True)


def test_a_folder_of_clouds_with_a_template(tmp_path):
    s, rng = sample(), np.random.default_rng(0)
    folder = tmp_path / "clouds"
    folder.mkdir()
    for k in range(3):
        io.write_points(folder / f"{k}.ply", rng.permutation(s.garment_vertices[k])[:900])
    io.write_mesh(tmp_path / "template.obj", s.garment_rest, s.garment_faces)
    source = source_of(open_dataset(folder, fps=10), Sensor(points=500, noise=0), template=tmp_path / "template.obj")
    frames = list(source)
    assert [len(frame.points) for frame in frames] == [500] * 3
    assert frames[2].timestamp == pytest.approx(0.2)
    assert frames[0].truth is None
    assert source.start is None
    assert source.garment.n_vertices == len(s.garment_rest)
    hidden = list(source_of(open_dataset(folder, fps=10), Sensor(points=900, occlude=(1, 2)), template=tmp_path / "template.obj"))
    assert [len(frame.points) for frame in hidden] == [900, 540, 900]
    with pytest.raises(InvalidArgument, match="errors of its own"):
        source_of(open_dataset(folder), Sensor(fliers=0.1), template=tmp_path / "template.obj")


def test_colours_of_a_folder_reach_the_tracker(tmp_path, monkeypatch):
    s, rng, folder = sample(), np.random.default_rng(0), tmp_path / "clouds"
    io.write_mesh(tmp_path / "template.obj", s.garment_vertices[0], s.garment_faces)
    folder.mkdir()
    header = ["ply", "format ascii 1.0", "element vertex 400", *(f"property float {axis}" for axis in "xyz")]
    header += [*(f"property uchar {name}" for name in ("red", "green", "blue")), "end_header", ""]
    for k in range(3):
        points = rng.permutation(s.garment_vertices[k])[:400]
        rows = (f"{x:.4f} {y:.4f} {z:.4f} {int(100 * y) % 256} 60 120\n" for x, y, z in points)
        (folder / f"{k}.ply").write_text("\n".join(header) + "".join(rows))
    source = source_of(open_dataset(folder, fps=10), Sensor(points=300, drop=0.1, noise=0), template=tmp_path / "template.obj")
    for frame in source:
        assert len(frame.colors) == len(frame.points) < 300
        assert np.abs(frame.colors[:, 0] - np.floor(100 * frame.points[:, 1]) % 256).max() <= 1
    given, step = [], ddakf.Tracker.step
    monkeypatch.setattr(ddakf.Tracker, "step", lambda *frame, **rest: given.append(rest.get("colors")) or step(*frame, **rest))
    tracked = [frame for frame, _, _ in replay.local(source)]
    assert all(np.array_equal(colors, frame.colors) for colors, frame in zip(given[-3:], tracked, strict=True))


def test_what_cannot_be_opened(tmp_path):
    with pytest.raises(InvalidFile, match="nothing there"):
        source_of(open_dataset(tmp_path / "none.npz"))
    with pytest.raises(InvalidArgument, match="template"):
        source_of(open_dataset(SAMPLE), template="x.obj")
    io.write_mesh(tmp_path / "0.ply", np.eye(3), np.array([[0, 1, 2]]))
    io.write_mesh(tmp_path / "1.ply", np.eye(3), np.array([[0, 1, 2]]))
    with pytest.raises(InvalidArgument, match="body"):
        source_of(open_dataset(tmp_path), give_body=True)
