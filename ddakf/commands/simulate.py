"""``ddakf simulate``: makes a recording of a garment on a moving body, from CC0 parts."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from ddakf.errors import InvalidArgument

GARMENTS = (
    "tshirt", "tank", "skirt", "dress", "long-shirt", "trousers", "shorts", "straight-skirt", "jacket", "hoodie", "cape",
)  # fmt: skip
MOTIONS = (
    "walk", "swing", "crossed-arms", "jump", "twist", "squat", "dance", "turn", "sit", "run", "overhead", "lie", "random",
)  # fmt: skip
FITS = ("close", "regular", "loose")
FABRICS = ("cotton", "silk", "jersey", "wool", "denim")
EPILOG = """
The first frame compiles for about two minutes, once per installation; after that 0.3 to 3 seconds per frame. Quality figures
(stretch, penetration, displacement) go into a .json file beside the recording; a recording that fails them is not written.
"""


def register(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = commands.add_parser("simulate", help="simulate a garment on a moving body (CC0)", epilog=EPILOG)
    parser.add_argument("--garment", choices=GARMENTS, required=True)
    parser.add_argument("--motion", choices=MOTIONS, required=True)
    parser.add_argument("--frames", type=int, default=150, metavar="N", help="frames of the recording (default 150)")
    parser.add_argument("--fps", type=float, default=30.0, help="frames per second (default 30)")
    parser.add_argument(
        "--vertices", type=int, default=2700, metavar="V", help="approximate number of vertices of the garment (default 2700)"
    )
    seed_help = "seed by which the garment's measures and the motion vary (default 0: unchanged)"
    parser.add_argument("--seed", type=int, default=0, metavar="N", help=seed_help)
    parser.add_argument("--fit", choices=FITS, default="regular", help="how loose the garment is (default regular)")
    parser.add_argument(
        "--fabric", choices=FABRICS, default="cotton", help="fabric: its weight, stretch, bending and friction (default cotton)"
    )
    body_help = "seed of the body's shape (default 0: the body that ships)"
    parser.add_argument("--body", type=int, default=0, metavar="N", help=body_help)
    parser.add_argument("--out", type=Path, metavar="FILE.npz", help="file for the recording (default GARMENT_MOTION.npz)")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Simulates a recording, writes it and prints its quality."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from ddakf.evaluation.simulation import simulated_recording, solver

    target = _target(arguments.out or Path(f"{arguments.garment}_{arguments.motion}.npz"))
    if arguments.out is None and target.exists():
        raise InvalidArgument("out", f"a name, as {target} exists; --out {target} replaces it", "none")
    order = simulated_recording.Order(
        arguments.garment, arguments.motion, arguments.frames, arguments.vertices, arguments.fps, arguments.seed,
        arguments.fit, arguments.fabric, arguments.body,
    )  # fmt: skip
    version = solver.version()  # refuses before any work where Newton is missing
    console = Console()
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("time left"), TimeRemainingColumn()
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("starting", total=None)

        def progress(done: int, total: int, what: str) -> None:
            bar.update(task, completed=done, total=total, description=what)

        sequence, pose = simulated_recording.record(order, progress)
    figures = simulated_recording.write(target, order, sequence, pose, version)
    console.print(f"{target}: {figures['vertices']} vertices, {figures['frames']} frames")
    console.print(
        f"stretch {figures['stretch_mean']:.3f} in the mean, {figures['stretch_p99']:.3f} at the 99th percentile; "
        f"inside the body {figures['inside_share_mean']:.2%}, at most {figures['penetration_max_mm']:.1f} mm deep; "
        f"{figures['displacement_mean_mm']:.1f} mm per frame",
        soft_wrap=True,
    )
    return 0


def _target(path: Path) -> Path:
    """The file to write. Its folder is created and checked before hours of work, not after."""
    if path.suffix != ".npz":
        raise InvalidArgument("--out", "a name that ends in .npz", str(path))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidArgument("--out", "a folder that can be made", f"{path.parent} ({error.strerror})") from error
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise InvalidArgument("--out", "a file that can be written", str(path))
    return path
