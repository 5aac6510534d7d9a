"""Messages of the command line: one sentence, of the command that was meant, with the names that were written."""

import importlib.metadata

import pytest

from ddakf.commands import cli
from ddakf.data import SAMPLE

pytestmark = pytest.mark.skipif(
    "serve" not in {entry.name for entry in importlib.metadata.entry_points(group=cli.GROUP)}, reason="needs the service"
)


def refusal(capsys, *words) -> str:
    """The one line of a refused command."""
    try:
        status = cli.main(words)
    except SystemExit as ended:  # of the parser
        status = ended.code
    assert status == 2
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = err.splitlines()
    return line


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("trakc", ["ddakf: ", "did you mean track?"]),
        ("serve --port 7", ["ddakf serve: unknown option --port", "--http-port", "--grpc-port"]),
        ("serve --prot=7", ["ddakf serve: unknown option --prot"]),
        ("serve now", ["ddakf serve: unexpected argument 'now'"]),
        ("serve --host", ["ddakf serve: ", "--host", "expected one argument"]),
        ("keys", ["ddakf keys: ", "ACTION"]),
        ("keys lits", ["ddakf keys: ", "create, list or revoke", "did you mean list?"]),
        ("keys list x", ["ddakf keys list: unexpected argument 'x'"]),
        ("keys create x", ["ddakf keys create: ", "--scope"]),
        ("keys create x --scope red", ["ddakf keys create: ", "stream, read or admin", "did you mean read?"]),
        ("keys create x --scope read --data-dri D", ["unknown option --data-dri; did you mean --data-dir"]),
        ("keys --data-dir D create x --scope read --max-sessions 99999999999", ["max_sessions", "2147483647"]),
        ("doctor --wram", ["ddakf doctor: unknown option --wram; did you mean --warm?"]),
        ("demo --out /proc/nothing", ["/proc/nothing: "]),
        ("report --out /proc/nothing", ["/proc/nothing: "]),
        ("demo --frames x", ["ddakf demo: ", "--frames", "expected a whole number, got 'x'"]),
        ("track SAMPLE --fps x", ["ddakf track: ", "--fps", "expected a number, got 'x'"]),
        ("evaluate smaple --json O.json", ["sequence: expected a path, or one of sample", "got 'smaple'; did you mean sample?"]),
        ("evaluate sample --json OUT", ["json: expected a name that ends in .json, got OUT"]),
        ("evaluate sample --json no/OUT.json", ["json: expected a file in a folder that exists, got no/OUT.json"]),
        ("evaluate sample --json O.json --quick", ["quick", "--paper"]),
        ("evaluate sample --json O.json --methods nipc", ["methods: expected ddakf, ", "did you mean nicp"]),
        ("evaluate sample --json O.json --frames 0:400", ["frames: expected at most :150, the frames of sample, got '0:400'"]),
        ("evaluate sample --json O.json --noise-mm -1", ["noise_mm: expected millimetres in [0, 1000), got -1.0"]),
        ("track SAMPLE --frames 0:400", ["frames: expected at most :150, the frames of the recording, got '0:400'"]),
        ("track SAMPLE --frames 0:9 --every 9", ["every", "--every 9, which leaves none"]),
        ("track SAMPLE --frames 0:9 --occlude 20:30", ["occlude: expected some of the frames 0 to 8, got 20:30"]),
        ("track SAMPLE --seed -1", ["seed: expected a number from 0, got -1"]),
        ("track SAMPLE --fps 60", ["fps: expected none for a sequence"]),
        ("track SAMPLE --noise-mm nan", ["noise_mm: expected millimetres"]),
        ("track SAMPLE --out .", ["out: expected a file in a folder that exists, got ."]),
        ("track SAMPLE --picture p.xyz", ["picture: expected a name that ends in .png", ".xyz"]),
    ],
)
def test_a_wrong_command_line_is_refused_in_one_sentence(capsys, monkeypatch, tmp_path, words, parts):
    monkeypatch.chdir(tmp_path)
    line = refusal(capsys, *(str(SAMPLE) if word == "SAMPLE" else word for word in words.split()))
    assert [part for part in parts if part not in line] == []


def test_the_database_of_keys_is_named_on_either_side_of_the_action(capsys, tmp_path):
    before, after = tmp_path / "before", tmp_path / "after"
    assert cli.main(["keys", "--data-dir", str(before), "create", "x", "--scope", "read"]) == 0
    assert cli.main(["keys", "create", "x", "--scope", "read", "--data-dir", str(after)]) == 0
    assert {path.name for path in tmp_path.glob("*/ddakf.sqlite*")} >= {"ddakf.sqlite"}
    assert {path.parent for path in tmp_path.glob("*/ddakf.sqlite")} == {before, after}
