"""Dependencies: what the core runs without, and a reason for each one that it has."""

import ast
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ddakf.data.rotation import SMALL_ANGLE, rotation_matrices

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
OWN = ("protos", "clients/python")  # folders of the other distributions
OPTIONAL = ("scipy", "PIL", "matplotlib", "open3d", "torch", "newton", "warp", "grpc", "google", "fastapi", "pydantic")
WITHOUT = f"""
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {OPTIONAL}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
"""


def run_without(program: str) -> str:
    """The output of a program in a process where the optional packages are absent."""
    done = subprocess.run([sys.executable, "-c", WITHOUT + program], capture_output=True, text=True, timeout=250, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_the_library_and_its_tracking_load_without_optional_packages():
    run_without("import ddakf, ddakf.commands.cli, ddakf.evaluation.tracking.replay, ddakf.evaluation.tracking.scoreboard")


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["ddakf.Config()", "ddakf.Config.paper()"])
def test_a_sequence_is_tracked_without_optional_packages(preset):
    program = f"""
import ddakf, ddakf.data
from ddakf.evaluation.tracking.sources import SequenceSource
from ddakf.evaluation.sensors import Sensor
source = SequenceSource(ddakf.data.sample(), Sensor("front", 2000), range(6), give_body=True)
tracker = ddakf.Tracker(source.garment, body=source.body, config={preset})
tracker.reset(vertices=source.start)
results = [tracker.step(frame.points, timestamp=frame.timestamp, sensor_origin=frame.sensor_origin) for frame in source]
print(len(results), results[-1].state)
"""
    assert run_without(program) == "5 tracking"


def test_a_command_that_needs_an_absent_package_says_so():
    program = """
from ddakf.commands import cli
sys.exit(0 if cli.main(["evaluate", "sample", "--json", "x.json"]) == 2 else 1)
"""
    done = subprocess.run([sys.executable, "-c", WITHOUT + program], capture_output=True, text=True, timeout=250, check=False)
    assert done.returncode == 0
    assert done.stderr == "ddakf: evaluate needs scipy, which is not installed: pip install 'ddakf[evaluation]'\n"


def test_no_kernel_calls_linear_algebra_that_numba_takes_from_scipy():
    for path in sorted((ROOT / "ddakf/kernels").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            assert not isinstance(node, ast.BinOp) or not isinstance(node.op, ast.MatMult), path.name
            called = isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "np"
            assert not called or node.attr not in ("dot", "vdot", "linalg"), path.name


def test_every_dependency_has_its_reason_and_its_replacement_in_the_document():
    sections = dict(re.findall(r"^## (.+)\n((?:(?!## ).*\n)*)", (ROOT / "docs/dependencies.md").read_text(), re.M))
    documented = re.findall(r"^\| `([^`]+)` \|", sections["Library"] + sections["Extras"], re.M)
    projects = [PROJECT, *(tomllib.loads((ROOT / name / "pyproject.toml").read_text())["project"] for name in OWN)]
    groups = [{"": project["dependencies"], **project["optional-dependencies"]} for project in projects]
    texts = [text for group in groups for extra, needed in group.items() if extra != "dev" for text in needed]
    named = {re.match(r"[A-Za-z0-9-]+", text).group() for text in texts}
    assert sorted(documented) == sorted(named)
    assert sorted(in_first_cells(sections["Replacements"])) == sorted(name for name in named if not name.startswith("ddakf-"))


def test_every_package_of_npm_has_its_reason_in_the_document():
    packages = [json.loads((ROOT / f"clients/{name}/package.json").read_text()) for name in ("typescript", "dashboard")]
    of_npm = {name for package in packages for kind in ("dependencies", "devDependencies") for name in package[kind]}
    web = (ROOT / "docs/dependencies.md").read_text().partition("\n## Web\n")[2].partition("\n## ")[0]
    assert {name for name in of_npm if not name.startswith("@types/")} - {"ddakf-client"} == set(in_first_cells(web))


def in_first_cells(section: str) -> list[str]:
    """The names in the first column of the tables of a section."""
    return [name for line in section.splitlines() if line.startswith("|") for name in re.findall("`([^`]+)`", line.split("|")[1])]


def test_rotation_matrices_are_those_of_scipy():
    vectors = np.random.default_rng(3).normal(size=(500, 4, 3))
    vectors[:9] *= 1e-5
    vectors[9, 0] = 0
    vectors[9, 1] = [SMALL_ANGLE, 0, 0]
    expected = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(500, 4, 3, 3)
    np.testing.assert_allclose(rotation_matrices(vectors), expected, rtol=0, atol=1e-15)
