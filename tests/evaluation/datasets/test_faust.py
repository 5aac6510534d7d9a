"""FAUST: the published layout is read, and a clip leads from the neutral pose to another one, limbs as long as they are."""

import numpy as np
import pytest

from ddakf.errors import InvalidArgument, InvalidFile
from ddakf.evaluation.datasets import faust
from ddakf.evaluation.datasets.faust import load_faust
from ddakf.files import io
from tests.evaluation.datasets.test_pose_interpolation import TUBE, lengths, rolled_up


def ascii_ply(path, vertices, faces):
    """As the registrations are published: ascii, or binary, with normals and colours."""
    header = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n" + "".join(
        f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz")
    )
    header += f"property uchar red\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = ["{:.7g} {:.7g} {:.7g} 0 0 1 255".format(*vertex) for vertex in vertices]
    path.write_text(header + "\n".join(rows + ["3 {} {} {}".format(*face) for face in faces]) + "\n")


@pytest.fixture
def published(tmp_path):
    """MPI-FAUST with poses 0 to 2 of subjects 0 and 3, pose 0 of subject 9, and a scan; subject 5 without a neutral pose."""
    registrations = tmp_path / "MPI-FAUST" / "training" / "registrations"
    registrations.mkdir(parents=True)
    for subject, poses in ((0, 3), (3, 3), (9, 1)):
        for pose in range(poses):
            shape = rolled_up(TUBE, 0.1 + 1.5 * pose + 0.1 * subject)
            write = ascii_ply if pose == 1 else io.write_mesh
            write(registrations / f"tr_reg_{subject}{pose}.ply".replace("reg_", "reg_0"), shape, TUBE.faces)
    io.write_mesh(registrations / "tr_reg_054.ply", TUBE.vertices, TUBE.faces)
    scans = registrations.parent / "scans"
    scans.mkdir()
    io.write_points(scans / "tr_scan_031.ply", TUBE.vertices[:50])
    return tmp_path / "MPI-FAUST"


@pytest.mark.parametrize("below", ["", "training", "training/registrations"])
def test_the_published_layout_is_found_from_any_of_its_folders(published, below):
    found = load_faust(published / below)
    assert found.subjects == (0, 3, 5, 9)
    assert found.clips == ("s0_p1", "s0_p2", "s3_p1", "s3_p2")
    assert found.registration(3, 1) == pytest.approx(rolled_up(TUBE, 1.9), abs=1e-6)
    assert found.registration(3, 2) == pytest.approx(rolled_up(TUBE, 3.4), abs=1e-6)
    assert found.scan(3, 1) == pytest.approx(TUBE.vertices[:50], abs=1e-6)
    assert np.array_equal(found.faces, TUBE.faces)
    assert faust.is_faust(published / below)


def test_a_clip_leaves_the_neutral_pose_and_holds_the_other_one(published):
    found = load_faust(published)
    clip = found.clip("s3_p2")
    assert (clip.name, clip.garment, clip.motion) == ("faust_s3_p2", "whole body", "p2")
    assert (len(clip), clip.fps) == (1 + faust.MOVING + faust.RESTING, 30.0)
    assert clip.garment_vertices[0] == pytest.approx(found.registration(3, 0), abs=1e-6)
    assert np.array_equal(clip.template, clip.garment_vertices[0])
    assert clip.garment_vertices[faust.MOVING] == pytest.approx(found.registration(3, 2), abs=1e-6)
    held = clip.garment_vertices[faust.MOVING :]
    assert np.array_equal(held, np.repeat(held[:1], faust.RESTING + 1, axis=0))
    step = np.linalg.norm(np.diff(clip.garment_vertices[: faust.MOVING + 1], axis=0), axis=2).max(axis=1)
    assert step[[0, -1]].max() < 0.02 * step.max()
    rest = lengths(TUBE, found.registration(3, 0))
    for vertices in clip.garment_vertices.astype(float):
        assert lengths(TUBE, vertices) == pytest.approx(rest, rel=0.2)  # rolling the tube up itself stretches its outer side


def test_an_archive_holds_the_same(published, tmp_path):
    shapes = np.stack([rolled_up(TUBE, 0.1 + 0.3 * k) for k in range(20)]).astype(np.float32)
    np.savez(tmp_path / "registrations_s0-s1.npz", V=shapes, F=TUBE.faces)
    found = load_faust(tmp_path / "registrations_s0-s1.npz")
    assert found.subjects == (0, 1)
    assert len(found.clips) == 18
    assert np.array_equal(found.registration(1, 4), shapes[14])
    assert found.clip("s1_p4").garment_vertices[-1] == pytest.approx(shapes[14], abs=1e-6)


def test_what_is_not_there_is_named_with_what_is(published):
    found = load_faust(published)
    with pytest.raises(InvalidArgument, match="s9_p3"):
        found.clip("s9_p3")
    with pytest.raises(InvalidArgument, match=r"one of those at hand \(s0_p1, .* got 's3_p0'"):
        found.clip("s3_p0")
    with pytest.raises(InvalidArgument, match=r"one of s0_p0, .* got s9_p1"):
        found.registration(9, 1)
    with pytest.raises(InvalidArgument, match="scan: expected one of s3_p1, got s3_p2"):
        found.scan(3, 2)


def test_what_is_not_faust_is_refused(published, tmp_path):
    io.write_mesh(published / "training/registrations/tr_reg_001.ply", TUBE.vertices, TUBE.faces[1:])
    with pytest.raises(InvalidFile, match="those of the other registrations"):
        load_faust(published).clip("s0_p1")
    io.write_mesh(published / "training/registrations/tr_reg_001.ply", np.concatenate([TUBE.vertices] * 2), TUBE.faces)
    with pytest.raises(InvalidFile, match=f"s0_p1: expected {TUBE.n_vertices} vertices as s0_p0, got {2 * TUBE.n_vertices}"):
        load_faust(published).clip("s0_p1")
    with pytest.raises(InvalidFile, match=r"tr_reg_000\.ply and so on"):
        load_faust(tmp_path)
    with pytest.raises(InvalidFile, match="nothing there"):
        load_faust(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(InvalidFile, match="with V and F"):
        load_faust(tmp_path / "text.npz")
    good = np.zeros((10, 3, 3)) + np.eye(3)
    for vertices, faces, said in (
        (good[:9], [[0, 1, 2]], "shape"),
        (good[:0], [[0, 1, 2]], "shape"),
        (good * np.nan, [[0, 1, 2]], "finite"),
        (good, [[0, 1, 3]], "indices"),
        (good * 0, [[0, 1, 2]], "area"),
        (good.astype(object), [[0, 1, 2]], "with V and F"),
    ):
        np.savez(tmp_path / "bad.npz", V=vertices, F=np.array(faces))
        with pytest.raises(InvalidFile, match=said):
            load_faust(tmp_path / "bad.npz")


@pytest.mark.recordings
def test_people_keep_their_limbs_on_the_way(recording):
    found = load_faust(recording("faust/registrations_s0-s7.npz"))
    assert found.subjects == tuple(range(8))
    assert len(found.clips) == 72
    clip = found.clip("s3_p7")  # both arms over the head, one knee up
    edges = np.unique(np.sort(np.concatenate([clip.garment_faces[:, :2], clip.garment_faces[:, 1:]]), axis=1), axis=0)
    first, last = (clip.garment_vertices[frame].astype(float) for frame in (0, -1))
    middle = clip.garment_vertices[faust.MOVING // 2].astype(float)

    def stretched(vertices):
        length, start, end = (np.linalg.norm(np.diff(v[edges], axis=1)[:, 0], axis=1) for v in (vertices, first, last))
        return np.abs(2 * length / (start + end) - 1)

    assert stretched(middle).mean() < 0.01
    assert np.percentile(stretched(middle), 99) < 0.1
    assert stretched(0.5 * (first + last)).mean() > 0.15
