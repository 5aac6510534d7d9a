"""Live view of a run in the terminal: reliability over time, frame rate, and how long each stage takes."""

from __future__ import annotations

import time
from collections import deque

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

_BARS = " ▁▂▃▄▅▆▇█"
_STYLES = {"tracking": "green", "recovering": "yellow", "lost": "red", "initializing": "blue"}
_REMEMBERED = 50  # frames of the curve
_SMOOTHING = 0.2  # weight of a frame in the mean time of a stage
_WIDTH = 28  # characters of the longest bar
_LEAST_SHARE = 0.01  # of a frame, below which a stage has no line
_NOT_STAGES = ("total", "server")  # sums of stages
_INTERVAL = 0.1  # s between two drawings


class LiveView:
    """A panel that is drawn again with the frames, as a context.

    Args:
        title: of the run.
        frames: how many there will be.
        console: where it is drawn.
    """

    def __init__(self, title: str, frames: int, console: Console):
        self._title, self._frames = title, frames
        self._live = Live(console=console, auto_refresh=False)
        self._results: deque = deque(maxlen=_REMEMBERED)
        self._arrivals: deque[float] = deque(maxlen=_REMEMBERED)
        self._stages: dict[str, float] = {}
        self._count, self._drawn = 0, 0.0

    def __enter__(self) -> LiveView:
        self._live.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        if self._results:
            self._live.update(self._panel(), refresh=True)
        self._live.__exit__(*error)

    def add(self, result, seconds: float) -> None:
        """Adds the result of a frame, which took so many seconds."""
        self._count += 1
        self._results.append((result, seconds))
        self._arrivals.append(time.monotonic())
        for stage, spent in result.timings.items():
            if stage not in _NOT_STAGES:
                self._stages[stage] = self._stages.get(stage, spent) * (1 - _SMOOTHING) + spent * _SMOOTHING
        if self._arrivals[-1] - self._drawn >= _INTERVAL:
            self._drawn = self._arrivals[-1]
            self._live.update(self._panel(), refresh=True)

    def _panel(self) -> Panel:
        result, seconds = self._results[-1]
        style = _STYLES.get(result.state, "white")
        figures = Table.grid(padding=(0, 3))
        state = Text(str(result.state), style=f"bold {style}")
        figures.add_row(state, f"frame {self._count} of {self._frames}", f"{self._rate():.0f} frames/s")
        sigma = 1e3 * float(result.sigma.mean())
        figures.add_row(f"{1e3 * seconds:.1f} ms", f"coverage {result.coverage:.0%}", f"sigma {sigma:.1f} mm")
        curve = Text.assemble("reliability  ", (self._curve(), style), f"  {result.reliability:.2f}")
        warnings = [Text(f"{warning.field}: {warning.message}", style="yellow") for warning in result.warnings]
        return Panel(Group(figures, curve, "", self._stage_table(), *warnings), title=Text(self._title), title_align="left")

    def _curve(self) -> str:
        values = (min(max(result.reliability, 0.0), 1.0) for result, _ in self._results)
        return "".join(_BARS[round(value * (len(_BARS) - 1))] for value in values)

    def _rate(self) -> float:
        """Frames per second, of the run as it is shown; the time of drawing is part of it."""
        span = self._arrivals[-1] - self._arrivals[0]
        return (len(self._arrivals) - 1) / span if span > 0 else 0.0

    def _stage_table(self) -> Table:
        rows = Table.grid(padding=(0, 2))
        total = sum(self._stages.values()) or 1.0
        longest = max(self._stages.values(), default=0.0) or 1.0
        for stage, spent in self._stages.items():
            if spent / total >= _LEAST_SHARE:
                bar = "█" * max(1, round(_WIDTH * spent / longest))
                rows.add_row(stage, Text(f"{1e3 * spent:.2f} ms", justify="right"), Text(bar, style="cyan"))
        return rows
