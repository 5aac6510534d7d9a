"""Command ``ddakf serve``: settings, the service in the foreground, progress and addresses."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import logging
import os
import sys
from collections.abc import Callable, Mapping

import uvloop
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

import ddakf
from ddakf.errors import InvalidConfig

from ..observability.logs import configure_logging
from ..server import Addresses, Server
from ..setting_sources import SettingSource, load, shown, unknown_variables
from ..settings import ENV_PREFIX, Settings
from ..workers.fork_server import ForkServer, WorkerStartFailed

Announcer = "ConsoleAnnouncer | JsonAnnouncer | LogAnnouncer"
EXIT_FAILED, EXIT_MISUSED = 1, 2

log = logging.getLogger(__name__)


def serve(args: argparse.Namespace, fork_server: ForkServer | None = None) -> int:
    """Runs the service until a signal and returns the exit status.

    Args:
        fork_server: of the workers, launched earlier.
    """
    flags = {name: v for name in Settings.model_fields if (v := getattr(args, f"setting_{name}")) is not None}
    try:
        settings, sources = load(flags, args.config)
        configure_logging(settings.log_level, settings.log_format)
        for sentence in unknown_variables():
            log.warning(sentence)
        if args.print_config:
            _print_settings(settings, sources, args.json)
            return 0
        return _serve(settings, args.json, args.with_parent, fork_server)
    except InvalidConfig as error:
        print(f"ddakf serve: {error}", file=sys.stderr)
        return EXIT_MISUSED
    except WorkerStartFailed as error:
        print(f"ddakf serve: {error}", file=sys.stderr)
        return EXIT_FAILED


def _serve(settings: Settings, as_json: bool, with_parent: bool, fork_server: ForkServer | None) -> int:
    # The workers read these, so that their log lines have the server's format.
    os.environ.update({f"{ENV_PREFIX}LOG_LEVEL": settings.log_level, f"{ENV_PREFIX}LOG_FORMAT": settings.log_format})
    _allow_connections()
    announcer = JsonAnnouncer() if as_json else LogAnnouncer() if settings.log_format == "json" else ConsoleAnnouncer()
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        try:
            runner.run(_run(settings, announcer, with_parent, fork_server))
        finally:
            announcer.close()
    return 0


def _allow_connections() -> None:
    """Raises the number of files and connections to what the system allows: shells and services begin with 1,024."""
    try:
        import resource
    except ImportError:  # not on Windows
        return
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(ValueError, OSError):  # macOS allows less than it says
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


async def _run(settings: Settings, announcer: Announcer, with_parent: bool, fork_server: ForkServer | None) -> None:
    server = Server(settings, fork_server)  # gRPC binds it to the running loop
    if with_parent:
        await _call_at_end_of_input(server.stop)
    await server.run(announcer.progress, announcer.ready)


async def _call_at_end_of_input(stop: Callable[[], None]) -> None:
    class Watch(asyncio.Protocol):
        def connection_lost(self, error: Exception | None) -> None:
            stop()

    await asyncio.get_running_loop().connect_read_pipe(Watch, sys.stdin)


class ConsoleAnnouncer:
    """Progress line and addresses for a person."""

    def __init__(self):
        self._console = Console()
        self._bar: Progress | None = None

    def progress(self, activity: str, done: int, total: int, name: str) -> None:
        if not self._console.is_terminal:
            self._console.print(f"{activity} kernels: {done} of {total}, {name}", highlight=False, soft_wrap=True)
            return
        if self._bar is None:
            self._bar = kernel_bar(self._console)
            self._bar.start()
            self._task = self._bar.add_task("", total=total, name="")
        self._bar.update(self._task, description=f"{activity} kernels", completed=done, total=total, name=name)

    def ready(self, addresses: Addresses) -> None:
        self.close()
        for line in (
            f"ddakf {ddakf.__version__} is ready; Ctrl-C stops it",
            f"  gRPC  {addresses.grpc}",
            f"  REST  {addresses.http}  (dashboard at /, documentation at /docs, metrics at /metrics)",
        ):
            self._console.print(line, highlight=False, soft_wrap=True)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


class JsonAnnouncer:
    """Progress and addresses as one JSON object per line, for a program; what libraries print goes to stderr."""

    def __init__(self):
        self._lines, sys.stdout = sys.stdout, sys.stderr  # Ray prints there that a node is lost

    def progress(self, activity: str, done: int, total: int, name: str) -> None:
        self._write(event=activity, done=done, total=total, name=name)

    def ready(self, addresses: Addresses) -> None:
        self._write(event="ready", grpc=addresses.grpc, http=addresses.http, pid=os.getpid())

    def close(self) -> None:
        """Gives stdout back."""
        sys.stdout = self._lines

    def _write(self, **event) -> None:
        self._lines.write(json.dumps(event) + "\n")
        self._lines.flush()


class LogAnnouncer:
    """Progress as lines of a JSON log, so that the output contains nothing else."""

    def progress(self, activity: str, done: int, total: int, name: str) -> None:
        log.info("%s kernels", activity, extra={"done": done, "total": total, "kernel": name})

    def ready(self, addresses: Addresses) -> None:
        """The server logs them itself."""

    def close(self) -> None:
        """Nothing stays open."""


def kernel_bar(console: Console) -> Progress:
    """A progress bar for the loading, or the compilation, of the kernels."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[name]}"),
    )
    return Progress(*columns, console=console, transient=True)


def _print_settings(settings: Settings, sources: Mapping[str, SettingSource], as_json: bool) -> None:
    if as_json:
        rows = {name: {"value": _shown(settings, name), "from": str(source)} for name, source in sources.items()}
        sys.stdout.write(json.dumps(rows, indent=2) + "\n")
        return
    table = Table("setting", "value", "from", "meaning", box=None, header_style="bold")
    for name, source in sources.items():
        table.add_row(name, str(_shown(settings, name)), str(source), Settings.model_fields[name].description)
    Console().print(table)


def _shown(settings: Settings, name: str):
    """A value without secrets."""
    value = getattr(settings, name)
    return shown(name, value) if isinstance(value, str) else value
