"""The live view of ``ddakf track --live``: what it says of the frames that it is given."""

import io
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from ddakf.commands import cli
from ddakf.commands.live import LiveView
from ddakf.data import SAMPLE


def result(reliability: float, *, state: str = "tracking", associate: float = 0.004):
    return SimpleNamespace(
        state=state,
        reliability=reliability,
        coverage=0.5,
        sigma=np.full(4, 0.006),
        timings={"associate": associate, "fuse": 0.008, "output": 1e-6, "total": 0.0121},
        warnings=(SimpleNamespace(field="points", message="they are in millimetres"),) if state == "lost" else (),
    )


def drawn(*results) -> str:
    """What a terminal shows at the end."""
    out = io.StringIO()
    with LiveView("a run", 9, Console(file=out, force_terminal=True, width=100, color_system=None)) as view:
        for each in results:
            view.add(each, 0.0125)
    last = out.getvalue().rpartition("╭")[2]
    assert last, "a panel was drawn"
    return last


def test_the_last_frame_its_curve_and_the_stages_are_shown():
    text = drawn(result(0.0), result(0.5), result(1.0))
    for part in ("a run", "tracking", "frame 3 of 9", "12.5 ms", "coverage 50%", "sigma 6.0 mm", "▄█  1.00"):
        assert part in text
    assert "fuse" in text
    assert "8.00 ms" in text


def test_bars_are_as_long_as_their_stages_and_sums_are_left_out():
    lines = drawn(result(0.9)).splitlines()
    bars = {name: next(line for line in lines if f" {name} " in line).count("█") for name in ("associate", "fuse")}
    assert bars["fuse"] == 2 * bars["associate"]
    assert not any("total" in line or "output" in line for line in lines)


def test_a_warning_has_its_sentence():
    assert "points: they are in millimetres" in drawn(result(0.1, state="lost"))


def test_without_frames_nothing_is_drawn():
    out = io.StringIO()
    with LiveView("a run", 9, Console(file=out, width=100)):
        pass
    assert "frame" not in out.getvalue()


@pytest.mark.slow
def test_a_run_is_shown_while_it_is_tracked(capsys):
    assert cli.main(["track", str(SAMPLE), "--frames", "0:4", "--points", "2000", "--live"]) == 0
    captured = capsys.readouterr()
    assert "frame 3 of 3" in captured.err
    assert "associate" in captured.err
    assert "RMSE" in captured.out
