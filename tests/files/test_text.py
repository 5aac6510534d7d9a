"""Files in the encodings and with the line ends of other programs."""

import numpy as np
import pytest

from ddakf.errors import InvalidFile
from ddakf.files import io

POINTS = np.array([[0.25, 0.5, 0.75], [1.0, 2.0, 3.0]])
COMMENT = "made by Åsa, х, \u2028 and end_header"
XYZ = f"# {COMMENT}\n0.25 0.5 0.75\n1 2 3\n"
OBJ = f"# {COMMENT}\nv 0.25 0.5 0.75\nv 1 2 3\n"
PLY = f"ply\nformat ascii 1.0\ncomment {COMMENT}\nelement vertex 2\n" + "".join(f"property float {a}\n" for a in "xyz")
PLY += "end_header\n0.25 0.5 0.75\n1 2 3\n"


@pytest.mark.parametrize(("suffix", "text"), [(".xyz", XYZ), (".csv", XYZ), (".obj", OBJ), (".ply", PLY)])
@pytest.mark.parametrize("line_end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1251"])
def test_text_is_read_in_the_usual_encodings_and_line_ends(tmp_path, suffix, text, line_end, encoding):
    if suffix == ".ply" and encoding in ("utf-8-sig", "utf-16"):
        pytest.skip("the header of a PLY file is ASCII")
    path = tmp_path / f"a{suffix}"
    path.write_bytes(text.replace("\n", line_end).encode(encoding, "replace"))
    assert np.array_equal(io.read_points(path), POINTS)


@pytest.mark.parametrize("line_end", [b"\n", b"\r\n", b"\r"])
def test_a_binary_ply_begins_after_its_header_whatever_its_bytes_are(tmp_path, line_end):
    """Its first byte may be that of a line end."""
    values = np.frombuffer(b"\n\r\x00\x3f" + np.array([0.5, 0.75], "<f4").tobytes(), "<f4")
    header = [b"ply", b"format binary_little_endian 1.0", b"element vertex 1"]
    header += [b"property float " + axis for axis in (b"x", b"y", b"z")]
    path = tmp_path / "a.ply"
    path.write_bytes(line_end.join([*header, b"end_header", values.tobytes()]))
    assert np.array_equal(io.read_points(path), values[None].astype(np.float64))


@pytest.mark.parametrize(
    "text",
    [
        '"","x","y","z"\n1,0.25,0.5,0.75\n2,1,2,3\n',
        ",x,y,z\n0,0.25,0.5,0.75\n1,1,2,3\n",
        "t z;Y;x\n9;0.75;0.5;0.25\n9;3;2;1\n",
        "x,y,z\n0.25,0.5,0.75\n1,2,3\n",
        "2\n0.25 0.5 0.75\n1 2 3\n",
        "X;Y;Z;red\n0.25; 0.5; 0.75; 9\n1;2;3;9\n",
    ],
)
def test_a_first_line_may_name_the_columns_or_count_the_points(tmp_path, text):
    (tmp_path / "a.csv").write_text(text)
    assert np.array_equal(io.read_points(tmp_path / "a.csv"), POINTS)


@pytest.mark.parametrize("text", ["0,25;0,5;0,75\n", "x y z\nx y z\n1 2 3\n", "1 2 3\nx y z\n", "1 2\n", "a\x00\x07b 1 2\n"])
def test_other_lines_are_refused_in_printable_words(tmp_path, text):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InvalidFile, match=r"a\.csv: line \d: expected three numbers with decimal points, got") as refused:
        io.read_points(tmp_path / "a.csv")
    assert str(refused.value).isprintable()
