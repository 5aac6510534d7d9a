"""``ddakf doctor``: what is installed, whether Open3D works, where compiled kernels are kept, which ports are free."""

from __future__ import annotations

import argparse
import json
import platform
import socket
from importlib import metadata

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

PACKAGES = (
    "ddakf", "ddakf-api", "ddakf-client", "numpy", "scipy", "numba", "rich", "grpcio", "protobuf", "fastapi", "uvicorn",
    "zstandard", "DracoPy", "pillow", "matplotlib", "open3d-cpu", "open3d", "torch", "ray",
)  # fmt: skip
PORTS = {"gRPC": 7701, "HTTP": 7702}  # defaults of `ddakf serve`
LOOPBACK = "127.0.0.1"


def register(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = commands.add_parser("doctor", help="what is installed, kernel cache, ports")
    parser.add_argument("--warm", action="store_true", help="compile all kernels now")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Prints the findings; always 0, since nothing that is checked here is required."""
    if arguments.warm:
        warm(Console(stderr=True))
    findings = examine()
    if arguments.json:
        print(json.dumps(findings))
    else:
        _print_table(findings)
    return 0


def warm(console: Console) -> None:
    """Compiles every kernel, or loads it from the cache, with a progress bar."""
    from ddakf.commands import warmup

    columns = (TextColumn("compiling kernels"), BarColumn(), TextColumn("{task.completed:.0f}/{task.total:.0f}"),
               TimeElapsedColumn(), TextColumn("{task.description}"))  # fmt: skip
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("", total=1)
        warmup.warm(lambda done, total, name: bar.update(task, completed=done, total=total, description=name))


def examine() -> dict:
    """Everything the command prints, as one dictionary.

    Returns:
        ``python`` and ``machine``; ``packages``: version or None by name; ``open3d``: "ok" or what to install;
        ``kernels``: directory, files and MiB of the cache; ``ports``: whether each default port of the service is
        free on the loopback.
    """
    return {
        "python": platform.python_version(),
        "machine": f"{platform.machine()} {platform.system()}",
        "packages": {name: _version(name) for name in PACKAGES},
        "open3d": _open3d(),
        "kernels": _kernel_cache(),
        "ports": {f"{name} {port}": _is_free(port) for name, port in PORTS.items()},
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _open3d() -> str:
    from ddakf.errors import MissingDependency
    from ddakf.files.open3d_bridge import import_open3d

    try:
        import_open3d()
    except MissingDependency as missing:
        return str(missing)
    return "ok"


def _kernel_cache() -> dict:
    from ddakf.kernels import CACHE_DIRECTORY

    sizes = [path.stat().st_size for path in CACHE_DIRECTORY.rglob("*") if path.is_file()]
    return {"directory": str(CACHE_DIRECTORY), "files": len(sizes), "mebibytes": round(sum(sizes) / 2**20, 1)}


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((LOOPBACK, port)) != 0


def _print_table(findings: dict) -> None:
    table = Table(show_header=False)
    table.add_row("Python", f"{findings['python']} on {findings['machine']}")
    for name, found in findings["packages"].items():
        table.add_row(name, found or "[dim]not installed[/dim]")
    table.add_row("Open3D works", findings["open3d"].replace("[", "\\["))
    cache = findings["kernels"]
    table.add_row("kernel cache", f"{cache['directory']}: {cache['files']} files, {cache['mebibytes']} MiB")
    for name, free in findings["ports"].items():
        table.add_row(f"port {name}", "free" if free else "in use")
    Console().print(table)
