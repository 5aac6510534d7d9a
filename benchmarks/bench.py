"""Speed beside accuracy, on one thread: ``python benchmarks/bench.py [--quick | --full] [--only PART ...]``.

Every part writes its measurements under its name into ``benchmarks/results/NAME.json``, with a description of the machine; those
of ``--only`` go to ``out``.
Compare ratios inside one run, and milliseconds of two runs only if the machine was otherwise idle.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

from committed import parsed

RESULTS = Path(__file__).parent / "results"
NAME, SOME = "bench", RESULTS.parents[1] / "out"
PARTS = ("frame", "changes", "open3d", "icp", "scaling", "outliers", "memory", "cold", "growth", "codecs", "images", "service")
ALL_CORES = ("service",)  # parts that are about several processes
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class Settings:
    """Size of the measurements; the defaults take a few minutes."""

    points: int = 10_000
    frames: int = 149  # of each sequence, at most
    change_frames: int = 149
    sizes: tuple[tuple[int, int], ...] = ((1_000, 5_000), (2_500, 10_000), (5_000, 20_000), (10_000, 40_000), (20_000, 80_000))
    scaling_frames: int = 20
    open3d_sizes: tuple[tuple[int, int], ...] = ((5_000, 20_000), (2_500, 10_000))
    open3d_frames: int = 20
    icp_size: tuple[int, int] = (2_500, 10_000)
    icp_frames: int = 30
    outlier_frames: int = 10
    memory_frames: int = 20
    cold_starts: int = 5
    growth_frames: int = 600
    codec_repeats: int = 30
    codecs: tuple[str, ...] = ("raw", "quantised", "morton-zstd", "morton-deflate")
    service_frames: int = 60
    clients: int = 4
    workers: int = 2
    client_frames: int = 120


FULL = replace(
    Settings(),
    frames=1_000,
    sizes=(*Settings.sizes, (40_000, 160_000), (80_000, 320_000)),
    open3d_frames=40,
    growth_frames=10_000,
    client_frames=149,
)
QUICK = Settings(
    points=2_000,
    frames=2,
    change_frames=2,
    sizes=((400, 2_000), (800, 4_000)),
    scaling_frames=2,
    open3d_sizes=((800, 2_000),),
    open3d_frames=2,
    icp_size=(800, 2_000),
    icp_frames=2,
    outlier_frames=1,
    memory_frames=3,
    cold_starts=1,
    growth_frames=4,
    codec_repeats=1,
    codecs=("raw", "morton-zstd"),
    service_frames=3,
    clients=2,
    workers=1,
    client_frames=3,
)


def main(argv: list[str] | None = None) -> int:
    """Measures, prints and writes; returns the exit status."""
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))  # before numpy, numba and Open3D are imported
    arguments = parsed(_parser(), argv)
    from report import show

    from ddakf.evaluation import machine

    settings = QUICK if arguments.quick else FULL if arguments.full else Settings()
    size = "quick" if arguments.quick else "full" if arguments.full else "default"
    report = {"name": arguments.name, "size": size, "commit": machine.commit(), "machine": machine.describe()}
    report["date"] = time.strftime("%Y-%m-%d")
    measure = _measures()
    for part in arguments.only or PARTS:
        print(f"{part} ...", file=sys.stderr, flush=True)
        with contextlib.nullcontext() if part in ALL_CORES else machine.one_core():
            report[part] = measure[part](settings)
    complete = arguments.only is None or arguments.name != NAME or arguments.out != RESULTS
    folder = arguments.out if complete else SOME  # some parts would replace the measurements of all
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{arguments.name}.json"
    path.write_text(json.dumps(report, indent=1) + "\n")
    show(report)
    print(path)
    return 0


def _measures() -> dict:
    import library
    import preprocessing
    import streaming

    from ddakf.commands import warmup

    warmup.warm()
    return {
        "frame": library.frames,
        "changes": library.changes,
        "open3d": preprocessing.against_open3d,
        "icp": preprocessing.against_icp,
        "scaling": library.scaling,
        "outliers": preprocessing.outliers,
        "memory": library.memory,
        "cold": library.cold,
        "growth": library.growth,
        "codecs": streaming.codec_costs,
        "images": streaming.image_costs,
        "service": streaming.through_a_service,
    }


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="a few seconds: shows that it runs, measures nothing")
    size.add_argument("--full", action="store_true", help="whole recordings, V up to 80,000, 10,000 frames for growth")
    parser.add_argument("--only", nargs="+", choices=PARTS, metavar="PART", help=f"some of {', '.join(PARTS)}")
    parser.add_argument("--name", default=NAME, help="of the result file (default bench)")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the result file (with --only default out)")
    return parser


if __name__ == "__main__":  # the service's workers are spawned: they import this file
    sys.exit(main())
