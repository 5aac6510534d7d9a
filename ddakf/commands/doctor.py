"""``ddakf doctor``: what is installed, whether Open3D works, where compiled kernels are kept, which ports are free.

With ``--server`` a server is examined from outside instead.
"""

from __future__ import annotations

import argparse
import json
import platform
import socket
from importlib import metadata

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from ddakf.commands.remote import server_options
from ddakf.errors import InvalidArgument

PACKAGES = (
    "ddakf", "ddakf-api", "ddakf-client", "numpy", "scipy", "numba", "rich", "grpcio", "protobuf", "fastapi", "uvicorn",
    "zstandard", "DracoPy", "mcap", "pillow", "matplotlib", "open3d-cpu", "open3d", "torch", "newton", "ray", "psycopg",
)  # fmt: skip
PORTS = {"gRPC": 7701, "HTTP": 7702}  # defaults of `ddakf serve`
HTTP_PORT = PORTS["HTTP"]
LOOPBACK = "127.0.0.1"


def register(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = commands.add_parser("doctor", help="what is installed, kernel cache, ports; or a server, from outside")
    parser.add_argument("--warm", action="store_true", help="compile all kernels now")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    remote = parser.add_argument_group("server")
    meaning = "examine the server with this gRPC address: version, certificate, clock, storage, a synthetic session"
    server_options.add(remote, server=None, meaning=meaning)
    remote.add_argument("--http", metavar="HOST:PORT", help=f"address of REST (default: port {HTTP_PORT} of the same host)")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Prints the findings. 0, since nothing that is checked here is required; of a server: 1 where a check failed."""
    if arguments.server is not None:
        return _examine_server(arguments)
    if others := [*server_options.given(arguments), *(["http"] if arguments.http else [])]:
        raise InvalidArgument(others[0], "--server beside it", "no --server")
    if arguments.warm:
        warm(Console(stderr=True))
    findings = examine()
    if arguments.json:
        print(json.dumps(findings))
    else:
        _print_table(findings)
    return 0


def _examine_server(arguments: argparse.Namespace) -> int:
    from ddakf.evaluation.tracking import deployment

    server = server_options.server_of(arguments)
    http = arguments.http or f"{server.target.rpartition(':')[0]}:{HTTP_PORT}"
    findings, console = [], Console(highlight=False, soft_wrap=True)
    colours = {deployment.OK: "green", deployment.WARNING: "yellow", deployment.FAILED: "red"}
    for finding in deployment.examine(server, http):
        findings.append(finding)
        if not arguments.json:
            console.print(f"[{colours[finding.outcome]}]{finding.outcome:8}[/] {finding.check:12} {escape(finding.message)}")
    if arguments.json:
        print(json.dumps([finding._asdict() for finding in findings]))
    return int(any(finding.outcome == deployment.FAILED for finding in findings))


def warm(console: Console) -> None:
    """Loads every kernel from the cache, or compiles it, with a progress bar."""
    from ddakf.commands import warmup

    columns = (TextColumn("{task.description} kernels"), BarColumn(), TextColumn("{task.completed:.0f}/{task.total:.0f}"),
               TimeElapsedColumn(), TextColumn("{task.fields[name]}"))  # fmt: skip
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("loading", total=1, name="")

        def show(activity: str, done: int, total: int, name: str) -> None:
            bar.update(task, description=activity, completed=done, total=total, name=name)

        warmup.warm(show)


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
    from ddakf.kernels import cache

    folders = cache.folders()
    sizes = [path.stat().st_size for folder in folders for path in folder.iterdir() if path.is_file()]
    places = ", ".join(dict.fromkeys(str(folder.parent) for folder in folders))
    return {"directory": places or str(cache.directory()), "files": len(sizes), "mebibytes": round(sum(sizes) / 2**20, 1)}


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
