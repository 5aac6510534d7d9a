"""Diagrams of measurements, drawn with matplotlib (extra ``evaluation``)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ddakf.errors import InvalidArgument, MissingDependency

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")  # Okabe and Ito, told apart without colour vision
STYLES = ("-", "--", "-.", ":")


def figure(width: float, height: float):
    """An empty ``matplotlib.figure.Figure`` of a width and height in inches.

    Raises:
        MissingDependency: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependency("matplotlib, which draws diagrams, is not installed: pip install 'ddakf[evaluation]'") from error
    return Figure(figsize=(width, height), layout="constrained")


def reliability_diagram(path, curves: Mapping[str, tuple]) -> None:
    """Nominal against observed coverage of the claimed ellipsoids, a line per group; calibrated is the diagonal.

    Args:
        path: of the picture, in any format that matplotlib writes.
        curves: by name, probabilities and observed shares of the vertices inside, both in [0, 1].

    Raises:
        InvalidArgument: no curve.
        MissingDependency: matplotlib is not installed.
    """
    if not curves:
        raise InvalidArgument("curves", "at least one group of vertices with covariances", "none")
    drawn = figure(4.6, 5.2)
    axes = drawn.add_subplot()
    axes.plot([0, 1], [0, 1], color="0.6", linewidth=1, label="calibrated")
    for number, (name, (nominal, observed)) in enumerate(curves.items()):
        style = {"color": COLOURS[number % len(COLOURS)], "linestyle": STYLES[number % len(STYLES)]}
        axes.plot([0, *nominal], [0, *observed], label=name, marker=".", markersize=4, **style)
    axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    axes.set(xlabel="probability of the claimed ellipsoid", ylabel="share of vertices inside it")
    axes.text(0.03, 0.93, "too cautious", color="0.45")
    axes.text(0.97, 0.04, "overconfident", color="0.45", ha="right")
    drawn.legend(loc="outside lower center", ncols=2, frameon=False)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn.savefig(path, dpi=120)
