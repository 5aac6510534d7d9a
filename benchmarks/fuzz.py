"""Fuzzing: damaged input for every reader of external bytes. ``python benchmarks/fuzz.py [--inputs 100000] [--only T]``.

Each target runs in a process of its own with little memory and a limit on the CPU time of one input, under two engines:
mutations of valid input drawn by hypothesis, and, if it is installed, atheris, which follows the Python code that they reach. A
refusal by an error of the product is an answer. Anything else, a hang or a dead process is a finding, whose input is saved. The
target "http" is schemathesis on the OpenAPI document of a service of its own. The target "cost" draws valid frames of adversarial
geometry (adversarial.py); one that takes three times the processor time of a spread cloud of its size is a finding (cost.py).
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

OUT, HTTP, COST = Path("out/fuzz"), "http", "cost"
MEMORY = 192 << 20  # bytes that a target may take beyond its memory after the valid inputs
SECONDS = 5.0  # of CPU time for one input
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
LONGEST = 1 << 16  # bytes of an input
REPORT_EVERY = 0.5  # s
COST_SIZES = (("2500:20000", "full"), ("2500:20000", "front+body"), ("10000:100000", "front"))  # vertices : points, view


def main(argv: list[str] | None = None) -> int:
    """Fuzzes, prints a table, and returns 1 if there are findings."""
    arguments = _parser().parse_args(argv)
    if arguments.child:
        return child(arguments)
    from fuzz_targets import all_targets

    known = [*all_targets(), HTTP, COST]
    if unknown := set(arguments.only or ()) - set(known):
        print(f"unknown targets {', '.join(sorted(unknown))}; there are {', '.join(known)}", file=sys.stderr)
        return 2
    if arguments.replay:
        if len(arguments.only or ()) != 1 or arguments.only[0] in (HTTP, COST):
            print("replay: expected --only with the target of the input", file=sys.stderr)
            return 2
        all_targets()[arguments.only[0]]().run(arguments.replay.read_bytes())
        return 0
    chosen = [name for name in arguments.only or known if name not in (HTTP, COST)]
    arguments.out.mkdir(parents=True, exist_ok=True)
    engines = ["hypothesis", *(["atheris"] if importlib.util.find_spec("atheris") else [])]
    each = max(1, round(arguments.inputs / max(1, len(chosen) * len(engines))))
    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    rows = []
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=each * len(chosen) * len(engines))
        for target in chosen:
            for engine in engines:
                bar.update(task, description=f"{target}, {engine}")
                rows.append(run_child(arguments, target, engine, each, lambda count: bar.advance(task, count)))
                if not console.is_terminal:
                    print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    if rows:
        _show(rows)
    sound = not any(row["finding"] for row in rows)
    if HTTP in (arguments.only or known):
        sound = http(arguments) and sound
    if COST in (arguments.only or known):
        sound = costs(arguments) and sound
    return int(not sound)


def run_child(arguments, target: str, engine: str, inputs: int, advance) -> dict:
    """Runs one target under one engine in a process; returns its report."""
    current = arguments.out / f"{target.replace(' ', '-')}-{engine}.input"
    command = [sys.executable, __file__, "--child", target, "--engine", engine, "--inputs", str(inputs)]
    command += ["--seed", str(arguments.seed), "--out", str(arguments.out)]
    log = arguments.out / f"{target.replace(' ', '-')}-{engine}.log"
    last = {"inputs": 0, "accepted": 0, "refused": 0, "slowest_ms": 0.0, "mib": 0.0}
    begun = time.monotonic()
    with log.open("w") as errors:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True, env={**os.environ, **ONE_THREAD})
        for line in process.stdout:
            try:
                now = json.loads(line)
            except ValueError:
                continue  # of the engine
            advance(now["inputs"] - last["inputs"])
            last = now
        status = process.wait()
    finding = ""
    if status or last["inputs"] < 0.5 * inputs:
        finding = _why(status, log)
        kept = current.with_suffix(".finding")
        kept.write_bytes(current.read_bytes() if current.exists() else b"")
        finding += f" ({kept})"
    current.unlink(missing_ok=True)
    return {"target": target, "engine": engine, **last, "seconds": round(time.monotonic() - begun, 1), "finding": finding}


def _why(status: int, log: Path) -> str:
    if status == -signal.SIGPROF:
        return f"more than {SECONDS:g} s of CPU time"
    if status < 0:
        return f"ended by {signal.Signals(-status).name}"
    lines = map(str.strip, log.read_text(errors="replace").splitlines())
    raised = [line for line in lines if line.partition(":")[0].endswith(("Error", "Exception"))]
    return raised[-1][:200] if raised else f"status {status}, see {log}"


# In the process of a target -----------------------------------------------------------------------------------------


def child(arguments) -> int:
    """Runs one target under one engine."""
    if arguments.engine == "atheris":
        import atheris

        import ddakf.tracker  # noqa: F401  before: what numba compiles must stay as it is

        with atheris.instrument_imports(include=["ddakf_api", "ddakf_service"]):
            import fuzz_targets
    else:
        import fuzz_targets
    target = fuzz_targets.all_targets()[arguments.child]()
    for seed in target.seeds:  # imports, compiles and starts what there is to start
        with _ignored(fuzz_targets.REFUSALS):
            target.run(seed)
    limit = _address_space() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    name = f"{arguments.child.replace(' ', '-')}-{arguments.engine}.input"
    trial = Trial(target, fuzz_targets.REFUSALS, arguments.out / name)
    with trial:
        (by_atheris if arguments.engine == "atheris" else by_hypothesis)(trial, target.seeds, arguments)
    return 0


class Trial:
    """Feeds inputs to a target, counts the answers and reports them as lines of JSON; an exception is a finding."""

    def __init__(self, target, refusals: tuple[type[Exception], ...], current: Path):
        self._target, self._refusals = target, refusals
        self._file = os.open(current, os.O_RDWR | os.O_CREAT | os.O_TRUNC)
        self._answers, self._slowest, self._reported = Counter(), 0.0, 0.0

    def __enter__(self) -> Trial:
        return self

    def __exit__(self, *_: object) -> None:
        self.report()

    def __call__(self, data: bytes) -> None:
        data = data[:LONGEST]
        os.pwrite(self._file, data, 0)  # for the report on a dead process
        os.ftruncate(self._file, len(data))
        # The default action ends the process wherever it is.
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        begun = time.process_time()
        try:
            self._target.run(data)
            self._answers["accepted"] += 1
        except self._refusals:
            self._answers["refused"] += 1
        signal.setitimer(signal.ITIMER_PROF, 0)
        self._slowest = max(self._slowest, time.process_time() - begun)
        if time.monotonic() - self._reported > REPORT_EVERY:
            self.report()

    @property
    def count(self) -> int:
        return self._answers.total()

    def report(self) -> None:
        self._reported = time.monotonic()
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        counts = {name: self._answers[name] for name in ("accepted", "refused")}
        line = {"inputs": self.count, **counts, "slowest_ms": round(1e3 * self._slowest, 1), "mib": round(peak)}
        print(json.dumps(line), flush=True)


def changes():
    """Strategy from which hypothesis draws mutations."""
    from hypothesis import strategies as st

    places = st.floats(0, 1, exclude_max=True)
    return st.lists(st.tuples(st.sampled_from(MUTATIONS), places, places, st.binary(min_size=1, max_size=8)), max_size=6)


def by_hypothesis(trial: Trial, seeds: list[bytes], arguments) -> None:
    """Mutations of the seeds, drawn by hypothesis; shrinking is left to a replay."""
    import hypothesis
    from hypothesis import strategies as st

    @hypothesis.seed(arguments.seed)
    @hypothesis.settings(
        max_examples=arguments.inputs,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(seed=st.sampled_from(seeds), changes=changes(), other=st.sampled_from(seeds))
    def run(seed, changes, other):
        trial(mutated(seed, changes, other))

    run()


def by_atheris(trial: Trial, seeds: list[bytes], arguments) -> None:
    """Mutations by libFuzzer, which saves those that reach new code, and ends the process itself."""
    import atheris

    def run(data: bytes) -> None:
        trial(data)
        if trial.count >= arguments.inputs:
            trial.report()
            os._exit(0)

    with tempfile.TemporaryDirectory() as corpus:
        for number, seed in enumerate(seeds):
            (Path(corpus) / str(number)).write_bytes(seed)
        options = [f"-seed={arguments.seed + 1}", f"-max_len={LONGEST}", "-rss_limit_mb=0", "-print_final_stats=0"]
        prefix = f"-artifact_prefix={arguments.out}/"
        atheris.Setup([sys.argv[0], f"-runs={2 * arguments.inputs}", prefix, *options, corpus], run)
        atheris.Fuzz()


def mutated(seed: bytes, changes: list[tuple], other: bytes) -> bytes:
    """The seed with some mutations, each a kind, two places in [0, 1) and some bytes."""
    data = bytearray(seed)
    for kind, first, second, value in changes:
        kind(data, int(first * len(data)), int(second * len(data)), value, other)
    return bytes(data)


def _flip(data, place, _, value, __):
    if data:
        data[place] ^= 1 << value[0] % 8


def _overwrite(data, place, _, value, __):
    data[place : place + len(value)] = value


def _extreme(data, place, _, value, __):
    """A number of 1 to 8 bytes that is as large, or as small, as can be, or its neighbour."""
    size = 1 << value[0] % 4
    number = (0, (1 << 8 * size) - 1, 1 << 8 * size - 1, (1 << 8 * size - 1) - 1)[value[0] // 4 % 4]
    data[place : place + size] = number.to_bytes(size, "little")


def _insert(data, place, _, value, __):
    data[place:place] = value


def _delete(data, place, end, _, __):
    del data[min(place, end) : max(place, end)]


def _repeat(data, place, end, _, __):
    data[place:place] = data[min(place, end) : max(place, end)]


def _cut(data, place, *_):
    del data[place:]


def _splice(data, place, _, __, other):
    data[place:] = other[place:]


MUTATIONS = (_flip, _flip, _overwrite, _overwrite, _extreme, _insert, _delete, _repeat, _cut, _splice)


class _ignored:
    """Without contextlib's frames, of which there would be one per input."""

    def __init__(self, errors: tuple[type[Exception], ...]):
        self._errors = errors

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind, *_: object) -> bool:
        return kind is not None and issubclass(kind, self._errors)


def _address_space() -> int:
    """Bytes, of this process."""
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


# Over HTTP ----------------------------------------------------------------------------------------------------------


def http(arguments) -> bool:
    """True if schemathesis found no status of 500 and above, and no answer outside the OpenAPI document."""
    from ddakf_service.commands.service_process import ServiceProcess

    service = ServiceProcess(["--workers", "1"], log=arguments.out / "service.log")
    try:
        service.wait_until_ready()
        command = [sys.executable, "-m", "schemathesis.cli", "run", f"{service.http}/openapi.json"]
        command += ["--checks", "not_a_server_error,content_type_conformance", "--seed", str(arguments.seed)]
        command += ["--max-examples", str(arguments.examples), "--phases", "examples,coverage,fuzzing", "--no-color"]
        return subprocess.run(command, check=False).returncode == 0
    finally:
        service.stop()


# Cost of a frame -----------------------------------------------------------------------------------------------------


def costs(arguments) -> bool:
    """True if no drawn session costs much more than a spread one; prints the others."""
    import cost

    from ddakf.commands import warmup

    os.environ.update(ONE_THREAD)
    warmup.warm()
    found = 0
    for size, view in COST_SIZES:
        for name, ratio in cost.findings(size, view, arguments.scenes, arguments.seed):
            print(f"cost, {size}, {view}: {ratio} times a spread cloud: {name}", flush=True)
            found += 1
    print(f"{len(COST_SIZES) * arguments.scenes} sessions of adversarial frames, {found} findings")
    return found == 0


def _show(rows: list[dict]) -> None:
    columns = "target", "engine", "inputs", "accepted", "refused", "slowest ms", "MiB", "finding"
    table = Table(*columns, box=None, header_style="bold")
    for row in rows:
        numbers = (str(row[key]) for key in ("inputs", "accepted", "refused", "slowest_ms", "mib"))
        table.add_row(row["target"], row["engine"], *numbers, row["finding"])
    console = Console(highlight=False, markup=False, soft_wrap=True)
    console.width = max(console.width, 140)
    console.print(table)
    total = sum(row["inputs"] for row in rows)
    console.print(f"{total:,} inputs, {sum(bool(row['finding']) for row in rows)} findings")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, default=100_000, help="of all targets together (default 100000)")
    parser.add_argument("--only", nargs="+", metavar="TARGET", help="some of the targets")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=OUT, help=f"folder of findings and logs (default {OUT})")
    parser.add_argument("--replay", type=Path, metavar="FILE", help="run the first target of --only on the input in a file")
    parser.add_argument("--examples", type=int, default=50, help="of each operation over HTTP (default 50)")
    parser.add_argument("--scenes", type=int, default=40, help="drawn for each size of the target cost (default 40)")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--engine", help=argparse.SUPPRESS)
    return parser


if __name__ == "__main__":
    sys.exit(main())
