"""The container's files agree with the repository: what they copy exists, what they set is a setting, ports are the defaults."""

import re
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCKERFILE = (ROOT / "docker/Dockerfile").read_text(encoding="utf-8")
COMPOSE = ROOT / "docker/compose.yaml"
DOCUMENT = (ROOT / "docs/container.md").read_text(encoding="utf-8")


def _ignored(path: str) -> bool:
    """Whether .dockerignore keeps a path out of the build; the last pattern that matches it or a parent decides."""
    ignored = False
    parents = [path, *map(str, Path(path).parents)]
    for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines():
        pattern = line.strip().removeprefix("!").removeprefix("**/")
        if pattern and not line.startswith("#") and any(fnmatch(parent, pattern) for parent in parents):
            ignored = not line.startswith("!")
    return ignored


def _settings() -> dict:
    return pytest.importorskip("ddakf_service.settings").Settings.model_fields


def test_what_is_installed_reaches_the_build():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    installed = {path.removeprefix("/src").strip("/") for path in re.findall(r"/src[\w/]*", DOCKERFILE)} - {""}
    assert installed == {"protos", "clients/python"}
    for path in (*installed, *project["tool"]["setuptools"]["package-dir"].values(), "pyproject.toml", "README.md", "LICENSE"):
        assert not _ignored(path), path
    for path in (".git", ".venv", "tests", "out"):
        assert _ignored(path), path


def test_copied_files_exist():
    for path in re.findall(r"^COPY (?!--from)(\S+) ", DOCKERFILE, re.MULTILINE):
        assert (ROOT / path).exists(), path
        assert path == "." or not _ignored(path), path
    assert (ROOT / "docker/start").stat().st_mode & 0o111 == 0o111


def test_exposed_ports_are_the_defaults():
    defaults = {str(_settings()[name].default) for name in ("grpc_port", "http_port")}
    assert set(re.search(r"^EXPOSE (.*)$", DOCKERFILE, re.MULTILINE)[1].split()) == defaults
    assert set(re.findall(r":(\d+):\1", COMPOSE.read_text(encoding="utf-8"))) == defaults


def test_variables_are_settings():
    others = {"DDAKF_CONFIG", "DDAKF_KERNEL_CACHE", "DDAKF_PUBLISH", "DDAKF_BUILD", "DDAKF_API_KEY"}
    known = {f"DDAKF_{name.upper()}" for name in _settings()} | others
    for text in (DOCKERFILE, COMPOSE.read_text(encoding="utf-8"), DOCUMENT):
        assert set(re.findall(r"DDAKF_[A-Z_]*[A-Z]", text)) <= known


def test_the_cache_is_compiled_for_the_cpu_that_the_image_names():
    stages = DOCKERFILE.split("\nFROM ")[1:]
    for variable in ("NUMBA_CPU_NAME=", "NUMBA_CPU_FEATURES="):
        values = [re.search(rf"{variable}(\S+)", stage)[1] for stage in stages]
        assert values[0] == values[1]


def test_compose_is_well_formed():
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    service = yaml.safe_load(COMPOSE.read_text(encoding="utf-8"))["services"]["ddakf"]
    assert (COMPOSE.parent / service["build"]["context"] / service["build"]["dockerfile"]).is_file()
    cache = re.search(r"DDAKF_KERNEL_CACHE=(/var\S+)", DOCKERFILE)[1]
    assert service["read_only"]
    assert {"/tmp", cache} <= set(service["tmpfs"])
