"""Mutation tests of the stages: ``python benchmarks/mutants.py [--mutants N] [--seed S]``.

Each mutant changes one operator, number or condition inside a function of a stage. The tests that execute the changed line run
until one fails, the fastest first. A mutant that no test notices is equivalent to the original, or shows a missing test. The
kernels are left out: a change would have to be compiled, and each kernel has a slow twin in its tests.

mutmut and cosmic-ray start one process per mutant, which imports numba and loads the kernels anew each time. Here each mutant is
a fork of one process that has loaded them.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import copy
import importlib.abc
import importlib.machinery
import importlib.util
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from committed import parsed

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / "benchmarks/results/mutants.json"
FOLDERS = ("stages", "physics", "body", "multiresolution", "search")  # of ddakf
TRACK = "tests/test_reference_track.py"
TESTS = [*(f"tests/{folder}" for folder in FOLDERS), "tests/kernels", TRACK, "tests/test_snapshot.py",
         *(f"tests/test_tracker{part}.py" for part in ("", "_ahead", "_input", "_loss"))]  # fmt: skip
PATIENCE = 30.0  # seconds beyond ten times what the tests take without a change
DURATIONS = "MUTANT_TEST_DURATIONS"  # environment variable: the file that the plugin below writes

# The mutations -----------------------------------------------------------------------------------------------------

# A comparison becomes its opposite: between real numbers, < in place of <= is the same program.
OPERATORS = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Div, ast.Mod: ast.Mult,
    ast.Pow: ast.Mult, ast.MatMult: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.And: ast.Or, ast.Or: ast.And,
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip


ROUNDING = 1e-6  # smaller numbers keep a division or a factorization regular; their size has no meaning


@dataclass(frozen=True)
class Mutant:
    path: str  # of the module, from the root
    node: int  # number of the changed node in the order of ast.walk
    part: int  # of a comparison with several operators
    lines: tuple[int, int]  # of the statement, the first and the last
    change: str  # the expression before and after


def mutated(node: ast.AST, part: int) -> ast.AST | None:
    """The node with its mutation, or None where it has none."""
    new = copy.deepcopy(node)
    if isinstance(node, (ast.BinOp, ast.AugAssign, ast.BoolOp)) and type(node.op) in OPERATORS:
        new.op = OPERATORS[type(node.op)]()
        return new
    if isinstance(node, ast.Compare):
        new.ops[part] = OPERATORS[type(node.ops[part])]()
        return new
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.Not, ast.USub, ast.Invert)):
        return new.operand
    if isinstance(node, ast.Constant) and isinstance(node.value, bool):
        new.value = not node.value
        return new
    if isinstance(node, ast.Constant) and isinstance(node.value, int):
        new.value = node.value + 1
        return new
    if isinstance(node, ast.Constant) and isinstance(node.value, float) and (node.value == 0 or abs(node.value) > ROUNDING):
        new.value = 2 * node.value if node.value else 1.0
        return new
    if isinstance(node, ast.IfExp):
        new.body, new.orelse = new.orelse, new.body
        return new
    if isinstance(node, (ast.If, ast.While)) and not isinstance(node.test, (ast.Compare, ast.BoolOp, ast.UnaryOp)):
        new.test = ast.UnaryOp(ast.Not(), new.test)
        return new
    return None


def mutants_of(path: Path) -> Iterator[Mutant]:
    """Every mutation inside the functions of a module; neither of annotations nor of what is raised."""
    tree = ast.parse(path.read_text())
    number = {id(node): i for i, node in enumerate(ast.walk(tree))}

    def visit(node: ast.AST, lines: tuple[int, int] | None, inside: bool) -> Iterator[Mutant]:
        if isinstance(node, (ast.Raise, ast.Assert, ast.Import, ast.ImportFrom)):
            return
        if isinstance(node, ast.FunctionDef) and any("njit" in ast.unparse(decorator) for decorator in node.decorator_list):
            return  # compiled: its lines are never seen to be executed
        if isinstance(node, ast.stmt):
            last = node.body[0].lineno - 1 if getattr(node, "body", None) else node.end_lineno
            lines = node.lineno, max(last, node.lineno)
        if inside and lines:
            for part in range(len(node.ops) if isinstance(node, ast.Compare) else 1):
                if (new := mutated(node, part)) is not None:
                    before, after = (ast.unparse(n).splitlines()[0] for n in (node, new))
                    yield Mutant(str(path.relative_to(ROOT)), number[id(node)], part, lines, f"{before}  ->  {after}")
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "args") and not isinstance(node, ast.Call):
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from visit(child, lines, inside or isinstance(node, ast.FunctionDef))

    yield from visit(tree, None, False)


def compiled(mutant: Mutant):
    """Code of the module with the mutation."""
    path = ROOT / mutant.path
    tree = ast.parse(path.read_text())
    target = list(ast.walk(tree))[mutant.node]

    class Change(ast.NodeTransformer):
        def visit(self, node: ast.AST) -> ast.AST:
            if node is target:
                return ast.copy_location(mutated(node, mutant.part), node)
            return self.generic_visit(node)

    return compile(ast.fix_missing_locations(Change().visit(tree)), str(path), "exec")


class Finder(importlib.abc.MetaPathFinder):
    """Imports the mutant in place of its module."""

    def __init__(self, mutant: Mutant):
        self.name = mutant.path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        self.mutant = mutant

    def find_spec(self, name, path=None, target=None):
        if name != self.name:
            return None
        finder, mutant = self, self.mutant

        class Loader(importlib.machinery.SourceFileLoader):
            def get_code(self, fullname):
                return compiled(mutant)

        loader = Loader(finder.name, str(ROOT / mutant.path))
        return importlib.util.spec_from_file_location(name, loader.path, loader=loader)


# The tests ---------------------------------------------------------------------------------------------------------


def pytest_runtest_logreport(report) -> None:
    """As a plugin of pytest: adds a test's seconds to the file that DURATIONS names."""
    with open(os.environ[DURATIONS], "a") as file:
        file.write(json.dumps([report.nodeid, report.duration, report.outcome]) + "\n")


def run_tests(tests: Sequence[str]) -> tuple[dict[str, float], dict[str, dict[int, set[str]]]]:
    """Seconds of every test that passes, and the tests that execute a line, by file and line."""
    import coverage

    with tempfile.TemporaryDirectory() as folder:
        files = {"COVERAGE_FILE": f"{folder}/coverage", DURATIONS: f"{folder}/durations"}
        plugins = ["-p", "mutants", "-p", "no:cacheprovider", "-p", "no:xdist"]
        options = ["--cov=ddakf", "--cov-context=test", "--cov-report="]
        command = [sys.executable, "-m", "pytest", *plugins, *options, *tests]
        path = os.pathsep.join([str(ROOT / "benchmarks"), os.environ.get("PYTHONPATH", "")])
        subprocess.run(command, env={**os.environ, **files, "PYTHONPATH": path}, cwd=ROOT, check=False)
        seconds: dict[str, float] = {}
        bad = set()
        for line in Path(files[DURATIONS]).read_text().splitlines():
            test, duration, outcome = json.loads(line)
            seconds[test] = seconds.get(test, 0.0) + duration
            if outcome != "passed":
                bad.add(test)
        data = coverage.CoverageData(files["COVERAGE_FILE"])
        data.read()
        executed = {}
        for file in data.measured_files():
            lines = data.contexts_by_lineno(file)
            names = {number: {context.rpartition("|")[0] for context in of if context} for number, of in lines.items()}
            executed[str(Path(file).relative_to(ROOT))] = {number: tests - bad for number, tests in names.items()}
    return {test: duration for test, duration in seconds.items() if test not in bad}, executed


def chosen_tests(mutant: Mutant, seconds: dict[str, float], executed: dict, budget: float) -> list[str]:
    """Tests that execute the statement, until the budget is spent: of its own file, the reference track, then the fastest."""
    lines = executed.get(mutant.path, {})
    tests = {test for number in range(mutant.lines[0], mutant.lines[1] + 1) for test in lines.get(number, ()) if test in seconds}
    own = f"test_{Path(mutant.path).stem}.py"
    chosen, spent = [], 0.0
    for test in sorted(tests, key=lambda test: (own not in test, TRACK not in test, seconds[test], test)):
        if not chosen or spent + seconds[test] <= budget:
            chosen.append(test)
            spent += seconds[test]
    return chosen


# The runs ----------------------------------------------------------------------------------------------------------


def load() -> None:
    """Loads everything but the stages: libraries, and the kernels in machine code."""
    import hypothesis  # noqa: F401
    import pytest  # noqa: F401
    import scipy.spatial  # noqa: F401

    from ddakf.commands import warmup

    warmup.warm()
    for name in [name for name in sys.modules if name.partition(".")[0] == "ddakf" and not name.startswith("ddakf.kernels")]:
        del sys.modules[name]


def child(mutant: Mutant | None, tests: Sequence[str]) -> None:
    """Runs the tests in this process and ends it with pytest's status."""
    import pytest

    os.setsid()
    resource.setrlimit(resource.RLIMIT_AS, (16 << 30, 16 << 30))
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(3):
        os.dup2(null, descriptor)
    if mutant is not None:
        sys.meta_path.insert(0, Finder(mutant))
    options = ["-x", "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:cov", "-W", "ignore:Module already imported"]
    os._exit(int(pytest.main([*options, *tests])))


@dataclass(frozen=True)
class Outcome:
    mutant: Mutant
    result: str  # killed, timeout, survived, not executed
    tests: int
    seconds: float


def check_unchanged(tests: Sequence[str]) -> None:
    """Ends the program where a test fails in a fork although nothing has been changed."""
    if (pid := os.fork()) == 0:
        child(None, tests)
    if status := os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]):
        raise SystemExit(f"the tests end with status {status} although nothing has been changed")


def outcomes(sample: Sequence[tuple[Mutant, list[str], float]], processes: int) -> Iterator[Outcome]:
    """Runs the tests of every mutant, as they end."""
    waiting, running = list(reversed(sample)), {}
    while waiting or running:
        while waiting and len(running) < processes:
            mutant, tests, seconds = waiting.pop()
            if not tests:
                yield Outcome(mutant, "not executed", 0, 0.0)
                continue
            if (pid := os.fork()) == 0:
                try:
                    child(mutant, tests)
                finally:
                    os._exit(70)
            running[pid] = mutant, tests, time.monotonic(), PATIENCE + 10 * seconds
        for pid, (mutant, tests, begun, limit) in list(running.items()):
            ended, status = os.waitpid(pid, os.WNOHANG)
            elapsed = time.monotonic() - begun
            if ended:
                result = "survived" if status == 0 else "killed"  # by a test, or where its file is imported
            elif elapsed > limit:
                os.killpg(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
                result = "timeout"
            else:
                continue
            del running[pid]
            yield Outcome(mutant, result, len(tests), elapsed)
        time.sleep(0.02)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--mutants", type=int, default=200, help="default 200")
    parser.add_argument("--seed", type=int, default=0, help="of the sample, default 0")
    parser.add_argument("--budget", type=float, default=20.0, help="seconds of tests per mutant, default 20")
    parser.add_argument("--processes", type=int, default=os.cpu_count(), help="default: as many as there are cores")
    parser.add_argument("--folders", nargs="+", default=FOLDERS, help=f"of ddakf, default {' '.join(FOLDERS)}")
    parser.add_argument("--only", nargs="+", metavar="MODULE", help="names of modules, default: all of the folders")
    parser.add_argument("--tests", nargs="+", default=TESTS, help="that may run, default: those of the stages and the tracker")
    parser.add_argument("--out", type=Path, default=RESULT)
    arguments = parsed(parser, argv)
    os.chdir(ROOT)
    sys.path.insert(0, str(ROOT))

    paths = sorted(path for folder in arguments.folders for path in (ROOT / "ddakf" / folder).glob("*.py"))
    paths = [path for path in paths if not arguments.only or path.stem in arguments.only]
    every = [mutant for path in paths for mutant in mutants_of(path)]
    sample = random.Random(arguments.seed).sample(every, min(arguments.mutants, len(every)))
    print(f"{len(sample)} of {len(every)} mutants of {len(paths)} modules", flush=True)
    seconds, executed = run_tests(arguments.tests)
    plan = []
    for mutant in sample:
        tests = chosen_tests(mutant, seconds, executed, arguments.budget)
        plan.append((mutant, tests, sum(seconds[test] for test in tests)))
    load()
    check_unchanged(sorted({test for _, tests, _ in plan for test in tests}))
    done = []
    with contextlib.suppress(KeyboardInterrupt):  # the sample is in random order: what is done is a sample too
        for outcome in outcomes(plan, arguments.processes):
            done.append(outcome)
            mutant, place = outcome.mutant, f"{len(done)}/{len(plan)}"
            if outcome.result in ("survived", "not executed"):
                line = f"{mutant.path}:{mutant.lines[0]}: {mutant.change}"
                print(f"{place} {outcome.result}: {line} ({outcome.tests} tests)", flush=True)
    count = {result: sum(o.result == result for o in done) for result in ("killed", "timeout", "survived", "not executed")}
    share = (count["killed"] + count["timeout"]) / max(len(done), 1)
    print(f"{share:.1%} of {len(done)} mutants killed: {count}")
    rows = [
        {**asdict(o.mutant), "result": o.result, "tests": o.tests, "seconds": round(o.seconds, 1)}
        for o in sorted(done, key=lambda o: (o.mutant.path, o.mutant.lines, o.mutant.node))
    ]
    from ddakf.evaluation import machine  # not before: a mutant is loaded instead of the original

    report = {"commit": machine.commit(), "seed": arguments.seed, "of": len(every), "killed_share": round(share, 3), **count}
    report["mutants"] = rows
    arguments.out.write_text(json.dumps(report, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
