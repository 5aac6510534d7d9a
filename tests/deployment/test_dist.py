"""Distributions: built as `make dist` builds them, installed into empty environments, and used there."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from weight import closure

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
UV = Path(sys.executable).with_name("uv")
WEB = ROOT / "clients/typescript"
NAMES = ("ddakf", "ddakf_api", "ddakf_client")
CONTENT = {
    "ddakf": ["ddakf/py.typed", "ddakf/data/sample.npz", "ddakf_service/static/dashboard/index.html", "ddakf_service/BUILD",
              "ddakf_service/store/tables/migrations/versions/0001_tables.py"],
    "ddakf_api": ["ddakf_api/v1/tracking.proto", "ddakf_api/v1/tracking_pb2.pyi", "ddakf_api/py.typed"],
    "ddakf_client": ["ddakf_client/py.typed", "ddakf_client/recordings/__init__.py"],
}  # fmt: skip
ALL = """
import ddakf, ddakf_api.v1.tracking_pb2, ddakf_client, ddakf_service.server, sys
for module in (ddakf, ddakf_api, ddakf_client, ddakf_service):
    assert module.__file__.startswith(sys.prefix)
"""
CLIENT = """
import ddakf_client, sys
assert ddakf_client.__file__.startswith(sys.prefix)
assert not {"ddakf", "numba"} & set(sys.modules)
print(len(ddakf_client.__all__))
"""


def run(*command: str | Path, folder: Path | None = None, **environment: str) -> str:
    """The output of a command in an environment without this checkout."""
    variables = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV", "DDAKF_"))}
    ended = subprocess.run(
        command, cwd=folder, env=variables | environment, capture_output=True, text=True, timeout=280, check=False
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


@pytest.fixture(scope="module")
def distributions(tmp_path_factory) -> Path:
    """Wheels and source archives; a wheel is built from its source archive."""
    if not UV.exists():
        pytest.skip("uv is not installed: pip install uv")
    folder = tmp_path_factory.mktemp("dist")
    run(UV, "build", "--quiet", "--all-packages", "--out-dir", folder, folder=ROOT, DDAKF_BUILD="0123456789ab")
    return folder


@pytest.fixture
def environment(tmp_path, distributions):
    """Installs distributions into an empty environment and returns the folder of its programs."""

    def install(*what: str, python: str = sys.executable) -> Path:
        run(UV, "venv", "--quiet", "--python", python, tmp_path / "empty")
        wheels = ["--find-links", str(distributions)]
        run(UV, "pip", "install", "--quiet", "--python", tmp_path / "empty", *wheels, *what)
        return tmp_path / "empty/bin"

    return install


def test_there_is_a_wheel_and_a_source_archive_of_each(distributions):
    found = {path.name for path in distributions.iterdir() if path.suffix in (".whl", ".gz")}
    wheels = {f"{name}-{VERSION}-py3-none-any.whl" for name in NAMES}
    assert found == wheels | {f"{name}-{VERSION}.tar.gz" for name in NAMES}


@pytest.mark.parametrize("name", NAMES)
def test_a_wheel_has_its_files_and_no_others(distributions, name):
    with zipfile.ZipFile(distributions / f"{name}-{VERSION}-py3-none-any.whl") as wheel:
        files = set(wheel.namelist())
    assert {*CONTENT[name], f"{name}-{VERSION}.dist-info/licenses/LICENSE"} <= files
    tops = {file.partition("/")[0] for file in files if ".dist-info/" not in file}
    assert tops == ({"ddakf", "ddakf_service"} if name == "ddakf" else {name})
    with tarfile.open(distributions / f"{name}-{VERSION}.tar.gz") as source:
        inside = {member.name.partition("/")[2] for member in source.getmembers()}
    assert {"pyproject.toml", "LICENSE"} <= inside
    assert not {path for path in inside if path.startswith(("tests/", "docs/", ".git"))}


def interpreters() -> list[str]:
    """Interpreters of this machine that ddakf supports, one of each version."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    found = []
    for name in ("python3.11", "python3.12", "python3.13"):
        # the name may be that of a shim of pyenv, which fails unless its version is chosen
        names = [path for path in (shutil.which(name), *map(str, pyenv.glob(f"versions/*/bin/{name}"))) if path]
        works = [path for path in names if subprocess.run([path, "--version"], capture_output=True, check=False).returncode == 0]
        found += works[:1]
    return found or [sys.executable]


EACH_INTERPRETER = pytest.mark.parametrize("python", interpreters(), ids=lambda path: Path(path).name)


@EACH_INTERPRETER
def test_the_client_works_in_an_empty_environment(environment, python):
    programs = environment(f"ddakf-client=={VERSION}", python=python)
    assert int(run(programs / "python", "-c", CLIENT)) > 10


@EACH_INTERPRETER
def test_the_service_works_in_an_empty_environment(environment, tmp_path, python):
    programs = environment(f"ddakf[service]=={VERSION}", python=python)
    assert run(programs / "ddakf", "--version").strip() == f"ddakf {VERSION}"
    settings = json.loads(run(programs / "ddakf", "serve", "--print-config", "--json"))
    assert settings["grpc_port"]["value"] == 7701
    run(programs / "ddakf", "keys", "create", "x", "--scope", "read", "--data-dir", str(tmp_path / "data"))
    assert run(programs / "python", "-c", "from ddakf_service.build import build; print(build())").strip() == "0123456789ab"


def test_the_source_archives_work_in_an_empty_environment(environment, distributions, tmp_path):
    api, client, service = (distributions / f"{name}-{VERSION}.tar.gz" for name in ("ddakf_api", "ddakf_client", "ddakf"))
    programs = environment(str(api), str(client), f"ddakf[service] @ {service.as_uri()}")
    run(programs / "python", "-c", ALL, folder=tmp_path)
    assert run(programs / "ddakf", "--version").strip() == f"ddakf {VERSION}"


def test_the_package_of_npm_works_in_an_empty_folder(tmp_path):
    if shutil.which("npm") is None or not (WEB / "node_modules").is_dir():
        pytest.skip("the packages of clients/typescript are not installed; `make test-web` installs them and runs this test")
    run("npm", "run", "--silent", "build", folder=WEB)
    run("npm", "pack", "--silent", "--pack-destination", tmp_path, folder=WEB)
    archive = tmp_path / f"ddakf-client-{VERSION}.tgz"
    with tarfile.open(archive) as content:
        assert {"package/LICENSE", "package/README.md", "package/dist/index.js"} <= set(content.getnames())
    project = tmp_path / "project"
    project.mkdir()
    (project / "package.json").write_text('{"type": "module", "private": true}')
    run("npm", "install", "--no-audit", "--no-fund", "--silent", archive, folder=project)
    program = "import * as client from 'ddakf-client'; console.log(Object.keys(client).length)"
    assert int(run("node", "--input-type=module", "-e", program, folder=project)) > 5


def test_one_version_is_everywhere():
    assert run(sys.executable, ROOT / "release/version.py").strip() == VERSION


def test_a_version_is_set_everywhere(tmp_path):
    places = {"release/version.py"}
    script = (ROOT / "release/version.py").read_text()
    places |= {name for name in ("pyproject.toml", "protos/pyproject.toml", "clients/python/pyproject.toml", "docker/Dockerfile",
                                 "clients/typescript/package.json", "clients/typescript/package-lock.json", "CITATION.cff",
                                 "uv.lock") if f'"{name}"' in script}  # fmt: skip
    for name in places:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    assert run(sys.executable, tmp_path / "release/version.py", "9.8.7rc1").strip() == "9.8.7rc1"
    assert "ddakf-api==9.8.7rc1" in (tmp_path / "pyproject.toml").read_text()
    assert VERSION not in (tmp_path / "CITATION.cff").read_text()
    refused = subprocess.run(
        [sys.executable, tmp_path / "release/version.py", "next"], capture_output=True, text=True, check=False
    )
    assert refused.returncode == 2


def test_every_licence_is_allowed():
    listed = run(sys.executable, ROOT / "release/licences.py")
    assert "grpcio" in listed
    assert "ray" in listed
    assert "unknown" not in listed


def test_the_lock_file_fits_the_ranges():
    if not UV.exists():
        pytest.skip("uv is not installed: pip install uv")
    run(UV, "lock", "--check", "--offline", folder=ROOT)


@pytest.mark.parametrize(
    ("image", "added"), [("", {}), ("-s3", {"s3": "s3fs"}), ("-ray", {"s3": "s3fs", "ray": "ray"})], ids=["full", "s3", "ray"]
)
def test_the_bill_of_materials_has_every_package_of_the_image(tmp_path, image, added):
    if not UV.exists():
        pytest.skip("uv is not installed: pip install uv")
    commands = [line.split() for line in run("make", "--dry-run", "sbom", folder=ROOT).splitlines()]
    (arguments,) = (words[1 : words.index("-o")] for words in commands if f"dist/ddakf{image}.cdx.json" in words)
    run(UV, *arguments, "--output-file", tmp_path / "sbom.json", folder=ROOT)
    bill = json.loads((tmp_path / "sbom.json").read_text())
    assert bill["bomFormat"] == "CycloneDX"
    found = {component["name"]: component for component in bill["components"]}
    assert closure(["service", "postgres", "tracing", *added]) <= set(found)
    assert {"s3fs", "ray"} & set(found) == set(added.values())
    assert found["numba"]["purl"].startswith("pkg:pypi/numba@")
