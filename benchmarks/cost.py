"""Cost of adversarial frames over that of spread ones of the same size: ``python benchmarks/cost.py [--sizes V:M ...]``.

A session of six frames runs in a process of its own, on one thread, from the true start; frames are tracked, doubted and lost.
With ``--search`` nobody has placed the template, and the first frame is searched for it. Its processor time, of each stage, of
its longest frame and in all, is divided by that of the dearest session with a spread cloud: tracked, 5 cm beside, shaken by 5
cm, or elsewhere in every frame. Each is the least of some repetitions. A stage that takes less than a twentieth of the dearest
spread session counts as one that takes this much.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

from committed import parsed

OUT = Path(__file__).parent / "results" / "cost.json"
SIZES = ("2500:10000", "2500:80000", "20000:200000")
FRAMES, REPEATS, LEAST, LIMIT = 6, 2, 0.05, 3.0
SECONDS = 120  # of processor time that one session may take
TABLE = "{:9} {:32} {:>8} {:>7} {:>8}  {}"


def main(argv: list[str] | None = None) -> int:
    """Measures, prints and writes; returns 1 where a session costs more than the limit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", nargs="+", default=SIZES, metavar="V:M", help="vertices and points")
    parser.add_argument("--presets", nargs="+", default=["default"], choices=["default", "paper"])
    parser.add_argument("--views", nargs="+", default=["full", "front+body"], choices=["full", "front", "front+body"])
    parser.add_argument("--only", nargs="+", metavar="SCENE")
    parser.add_argument("--search", action="store_true", help="nobody has placed the template")
    parser.add_argument("--repeats", type=int, default=REPEATS)
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parsed(parser, argv)
    from ddakf.commands import warmup
    from ddakf.evaluation import machine

    warmup.warm()
    report = {"commit": machine.commit(), "machine": machine.describe(), "frames": FRAMES, "search": arguments.search}
    report["rows"] = []
    for size in arguments.sizes:
        for view in arguments.views:
            session = Session(*map(int, size.split(":")), view, arguments.search)
            for preset in arguments.presets:
                print("\n" + TABLE.format("V:M", f"{view}, {preset}", "seconds", "ratio", "MiB", "stages above 1.5"))
                for row in rows(session, preset, arguments):
                    report["rows"].append({"size": size, "view": view, "preset": preset, **row})
                    _show(report["rows"][-1])
    arguments.out.write_text(json.dumps(report, indent=1) + "\n")
    worst = max(report["rows"], key=lambda row: row["ratio"])
    print(f"\nthe dearest: {worst['size']}, {worst['scene']}, {worst['ratio']} times a spread cloud; {arguments.out}")
    return int(any(max(row["ratio"], row["stages"].get("longest frame", 0.0)) > LIMIT for row in report["rows"]))


def rows(session: Session, preset: str, arguments) -> Iterator[dict]:
    """The spread scenes, then the others as they are measured."""
    import adversarial

    spread = {name: session.measured(scene, preset, arguments.repeats) for name, scene in adversarial.SPREAD.items()}
    dearest = dearest_of(spread.values())
    for name, one in spread.items():
        yield {"scene": name, **compared(one, dearest)}
    for name, scene in adversarial.scenes(session.body):
        if name in (arguments.only or [name]):
            yield {"scene": name, **compared(session.measured(scene, preset, arguments.repeats), dearest)}


def dearest_of(spread: Iterable[dict]) -> dict[str, float]:
    """The most seconds of each stage."""
    spread = list(spread)
    return {stage: max(one["seconds"][stage] for one in spread) for stage in spread[0]["seconds"]}


def findings(size: str, view: str, count: int, seed: int) -> Iterator[tuple[str, float]]:
    """Drawn sessions that cost more than the limit, in all or in their longest frame: name and ratio.

    What seems to cost too much is measured again, with the spread sessions, so that noise is no finding.
    """
    import adversarial
    import numpy as np

    session, rng = Session(*map(int, size.split(":")), view), np.random.default_rng(seed)

    def spread(repeats: int) -> dict[str, float]:
        return dearest_of(session.measured(scene, "default", repeats) for scene in adversarial.SPREAD.values())

    dearest = spread(REPEATS)
    for _ in range(count):
        name, scene = adversarial.drawn(session.body, rng)
        if excess(session.measured(scene, "default", 1), dearest) <= LIMIT:
            continue
        dearest = spread(2 * REPEATS)
        if (ratio := excess(session.measured(scene, "default", 2 * REPEATS), dearest)) > LIMIT:
            yield name, round(ratio, 2)


def excess(one: dict, dearest: dict[str, float]) -> float:
    """The larger ratio to the spread sessions, of all frames and of the longest."""
    row = compared(one, dearest)
    return max(row["ratio"], row["stages"].get("longest frame", 0.0))


def compared(one: dict, spread: dict[str, float]) -> dict:
    """Seconds, memory, and ratios to the spread sessions, in all and by stage."""
    floor = LEAST * spread["total"]
    ratios = {stage: max(s, floor) / max(spread[stage], floor) for stage, s in one["seconds"].items()}
    total = ratios.pop("total")
    return {
        "seconds": round(one["seconds"]["total"], 4),
        "ratio": round(total, 2),
        "mib": one["mib"],
        "stages": {stage: round(ratio, 2) for stage, ratio in ratios.items()},
        "refused": one["refused"],
    }


class Session:
    """A garment of a size and clouds of a size, tracked from the start under one scene after the other."""

    def __init__(self, vertices: int, points: int, view: str, search: bool = False):
        import inputs

        from ddakf import data

        view, _, body = view.partition("+")
        self.body, self.search = bool(body), search
        sequence = inputs.resampled(inputs.shortened(data.sample(), FRAMES), vertices)
        self.run = inputs.run_of(sequence, FRAMES, view, points, body=self.body)

    def measured(self, scene, preset: str, repeats: int) -> dict:
        """The least seconds of every stage, and the most memory in MiB."""
        ran = [in_a_process(lambda: self.once(scene, preset)) for _ in range(repeats)]
        stages = ran[0]["seconds"]
        least = {stage: min(one["seconds"].get(stage, SECONDS) for one in ran) for stage in stages}
        return {"seconds": least, "mib": max(one["mib"] for one in ran), "refused": ran[0]["refused"]}

    def once(self, scene, preset: str) -> dict:
        """Seconds of processor time by stage, summed over the frames."""
        import numpy as np

        import ddakf
        from ddakf.planning import clock

        run, seconds, refused, rng = self.run, {}, "", np.random.default_rng(1)
        begin = run.unplaced if self.search else run.tracker
        tracker = begin(ddakf.Config() if preset == "default" else ddakf.Config.paper())
        if scene.garment is not None:
            start = run.sequence.garment_vertices[0].astype(float)
            try:
                tracker.reset(vertices=scene.garment(start, start, rng))
            except ddakf.errors.InvalidFrame as refusal:
                refused = str(refusal)
        base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with mock.patch.object(clock, "time", SimpleNamespace(perf_counter=time.thread_time, thread_time=time.thread_time)):
            for number, cloud, how in run.frames():
                vertices = run.sequence.garment_vertices[number].astype(float)
                points = scene.cloud(cloud.points.astype(float), vertices, rng).astype(np.float32)
                if scene.body is not None:
                    how["body_vertices"] = scene.body(how["body_vertices"].astype(float), vertices, rng)
                try:
                    timings = tracker.step(points, **how).timings
                except ddakf.errors.InvalidFrame as refusal:  # of a first cloud; a client may then send a good one
                    refused, timings = str(refusal), tracker.step(cloud.points, **how).timings
                seconds["longest frame"] = max(seconds.get("longest frame", 0.0), timings["total"])
                for stage, s in timings.items():
                    seconds[stage] = seconds.get(stage, 0.0) + s
        used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - base
        return {"seconds": seconds, "mib": round(used / 1024), "refused": refused}


def in_a_process(job) -> dict:
    """What ``job`` returns, computed in a fork with a limit on the processor time."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read)
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        with os.fdopen(write, "w") as pipe:
            json.dump(job(), pipe)
        os._exit(0)
    os.close(write)
    with os.fdopen(read) as pipe:
        said = pipe.read()
    _, status = os.waitpid(child, 0)
    if said:
        return json.loads(said)
    if not os.WIFSIGNALED(status):
        raise RuntimeError(f"the measurement itself failed, with exit status {os.waitstatus_to_exitcode(status)}")
    return {"seconds": {"total": float(SECONDS)}, "mib": 0, "refused": f"ended by signal {os.WTERMSIG(status)}"}


def _show(row: dict) -> None:
    dear = {stage: ratio for stage, ratio in row["stages"].items() if ratio > 1.5}
    notes = [f"{stage} {ratio}" for stage, ratio in sorted(dear.items(), key=lambda one: -one[1])]
    notes += [f"refused: {row['refused']:.60}"] if row["refused"] else []
    print(TABLE.format(row["size"], row["scene"], row["seconds"], row["ratio"], row["mib"], ", ".join(notes)), flush=True)


if __name__ == "__main__":
    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"))
    sys.exit(main())
