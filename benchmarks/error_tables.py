"""Tables of docs/algorithm.md and docs/read_reliability.md: ``python benchmarks/error_tables.py``.

Prints, in Markdown, the shares in the ellipsoids and what the reliability was worth, as ``error_size.py`` has written them into
benchmarks/results/error_size.json and, with ``--fit``, into error_laws.json.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

RESULTS = Path(__file__).resolve().parent / "results"
GROUPS = ("seen", "hidden, body", "hidden")
SENSORS = ("all", "undisturbed", "1,000 points", "10 fps", "10 mm noise")


def shares(found: dict, laws: dict) -> str:
    """Share in the 90 % ellipsoids and NEES/3 of each split, of its undisturbed runs, and of the garment with the least share."""
    lines = ["| recordings | seen | hidden, body given | hidden, no body |", "|---|---|---|---|"]
    for title, rows in (
        ("held-out (22)", found["tables"]["held-out"]),
        ("fitted (54), garment left out", laws["tables"]["each garment left out"]),
        ("captures (3)", found["tables"]["captured"]),
    ):
        lines += [_line(title, rows, "all"), _line("undisturbed", rows, "undisturbed")]
        garments = {row["part"] for row in rows} - {*SENSORS, "captured"}
        if garments:
            cells = (_least([row for row in rows if row["group"] == group and row["part"] in garments]) for group in GROUPS)
            lines.append(f"| worst garment | {' | '.join(cells)} |")
    return "\n".join(lines)


def worth(said: list[dict]) -> str:
    """By band of the reliability, the highest first: share of the frames, the error that it says, and the true one."""
    lines = ["| reliability | frames | expected error, mm | true error, mm: median, 90 % below | frames better than expected |"]
    lines, frames = [*lines, "|---|---|---|---|---|"], sum(row["frames"] for row in said)
    for row in reversed(said):
        band = f"{row['from']:g} to {row['to']:g}"
        band = f"above {row['from']:g}" if row["to"] == 1.0 else f"below {row['to']:g}" if row["from"] == 0.0 else band
        true = f"{row['median_mm']:.0f}, {row['p90_mm']:.0f}"
        share, below = (f"{100 * value:.0f} %" for value in (row["frames"] / frames, row["below"]))
        lines.append(f"| {band} | {share} | {row['said_mm']:.0f} | {true} | {below} |")
    return "\n".join(lines)


def told(found: dict) -> str:
    """How well the reliability tells failed frames, and sigma the vertices' errors."""
    lines = []
    for split in ("held-out", "training"):
        views = {row["view"]: row for row in found["rankings"][split]}
        row = views["all"]
        sure = ", ".join(f"{100 * row[f'{word} while failed']:.1f} % {word}" for word in ("at least 0.9", "over 0.5"))
        lines.append(f"{split}: rho {row['rho']:.2f}, ROC {row['roc']:.2f}, failed {row['failed']} of {row['frames']}, {sure}")
        sigma = (f"{view} {views[f'{view}, undisturbed']['sigma']:.2f}" for view in ("front", "front+body", "full"))
        lines.append(f"{split}: rho of sigma, undisturbed: {', '.join(sigma)}")
    return "\n".join(lines)


def _line(title: str, rows: list[dict], part: str) -> str:
    cells = {row["group"]: f"{100 * row['coverage90']:.0f} %, {row['nees3']:.2f}" for row in rows if row["part"] == part}
    return f"| {title} | {' | '.join(cells[group] for group in GROUPS)} |"


def _least(rows: list[dict]) -> str:
    worst = min(rows, key=lambda row: row["coverage90"])
    return f"{100 * worst['coverage90']:.0f} % ({worst['part'].replace('-', ' ')})"


def read() -> tuple[dict, dict]:
    """What was found, and what the fit of the laws found."""
    return tuple(json.loads((RESULTS / f"{name}.json").read_text()) for name in ("error_size", "error_laws"))


def main() -> int:
    found, laws = read()
    print(shares(found, laws))
    print("log-likelihood of a vertex left out above that of one size:", laws["log_likelihood_gained"])
    levels = dict(zip(*found["levels"]["held-out"]["seen"], strict=True))
    print(f"held-out, seen: in the 50 % ellipsoids {levels[0.5]:.0%}, 99 % {levels[0.99]:.0%}")
    print(told(found), worth(found["said"]["held-out"]), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
