"""Code generator: writes the Python code of ``ddakf_api/v1/*.proto`` beside the schema, or checks that it is up to date.

    python protos/generate.py            # after every change of a .proto file
    python protos/generate.py --check    # exit 1 and name the files that differ

Needs the generator version of the ``dev`` extra, because the output is committed.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent
GENERATED = ("*_pb2.py", "*_pb2.pyi", "*_pb2_grpc.py")


def generate(out: Path) -> None:
    """Runs protoc on every schema of the package; writes below ``out`` at the path of the package."""
    from grpc_tools import _proto, protoc

    well_known_types = Path(next(iter(_proto.__path__)))
    schemas = sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("ddakf_api/v*/*.proto"))
    command = ["protoc", f"-I{ROOT}", f"-I{well_known_types}"]
    command += [f"--{plugin}={out}" for plugin in ("python_out", "pyi_out", "grpc_python_out")]
    if protoc.main([*command, *schemas]) != 0:
        raise SystemExit("protoc failed")


def stale_files() -> list[str]:
    """Paths, relative to ``protos``, of generated files that are missing, surplus or out of date."""
    with tempfile.TemporaryDirectory() as folder:
        generate(Path(folder))
        fresh, committed = _contents(Path(folder)), _contents(ROOT)
    return sorted(path for path in fresh.keys() | committed.keys() if fresh.get(path) != committed.get(path))


def _contents(root: Path) -> dict[str, bytes]:
    paths = (path for pattern in GENERATED for path in root.glob(f"ddakf_api/v*/{pattern}"))
    return {str(path.relative_to(root)): path.read_bytes() for path in paths}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 when the committed code differs")
    if not parser.parse_args().check:
        generate(ROOT)
        return 0
    stale = stale_files()
    for path in stale:
        print(f"{path} is out of date: run python protos/generate.py", file=sys.stderr)
    return 1 if stale else 0


if __name__ == "__main__":
    raise SystemExit(main())
