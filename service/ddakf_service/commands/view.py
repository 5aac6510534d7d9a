"""Command ``ddakf view``: the dashboard on a recording, served until Ctrl-C, or on a running server."""

from __future__ import annotations

import argparse
import http.client
import re
import signal
import sys
import tempfile
import urllib.error
import urllib.parse
import urllib.request
import webbrowser
from pathlib import Path

from ddakf_api.transport import is_loopback
from rich.console import Console

from ddakf.errors import DdakfError, InvalidArgument

from ..settings import RECORDING_SUFFIXES, Settings
from .service_process import ServiceFailed, ServiceProcess

EXIT_FAILED, EXIT_TERMINATED = 1, 143
_ADDRESS = re.compile(r"(?:https?://)?((?:[\w.-]+|\[[0-9A-Fa-f:.]+\])(?::[0-9]{1,5})?)/?", re.ASCII)
_PATIENCE = 5.0  # seconds for a server to answer


def view(args: argparse.Namespace) -> int:
    """Opens the dashboard and returns the exit status."""
    if (args.file is None) == (args.server is None):
        got = "none of them" if args.file is None else "both"
        raise InvalidArgument("file", "a file or --server HOST", got)
    return _view_server(args) if args.server else _view_file(args)


def _view_server(args: argparse.Namespace) -> int:
    matched = _ADDRESS.fullmatch(args.server)
    if matched is None:
        raise InvalidArgument("server", "HOST, HOST:PORT or http://HOST:PORT", args.server)
    host = matched[1]
    if not re.search(r":[0-9]+$", host) and not args.server.startswith("http"):
        host = f"{host}:{Settings.model_fields['http_port'].default}"
    address = f"{'https' if args.server.startswith('https') else 'http'}://{host}/"
    proxies = {} if is_loopback(urllib.parse.urlsplit(address).hostname or "") else None  # None: those of the environment
    opener = urllib.request.build_opener(urllib.request.ProxyHandler(proxies))
    try:
        with opener.open(f"{address}healthz", timeout=_PATIENCE):
            pass
    except http.client.HTTPException:
        got = f"{args.server}, which speaks another protocol"
        raise InvalidArgument("server", "the HTTP port, 7702 by default", got) from None
    except (urllib.error.URLError, OSError) as error:
        raise DdakfError(f"{address} does not answer: {getattr(error, 'reason', error)}") from None
    _show(address, args.browser)
    return 0


def _view_file(args: argparse.Namespace) -> int:
    path = Path(args.file)
    if not path.is_file() or path.suffix.lower() not in RECORDING_SUFFIXES:
        got = f"{path}: {'another ending' if path.is_file() else 'a folder' if path.is_dir() else 'nothing there'}"
        raise InvalidArgument("file", f"a file that ends in {' or '.join(RECORDING_SUFFIXES)}", got)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(EXIT_TERMINATED))
    with tempfile.TemporaryDirectory(prefix="ddakf-view-") as folder:
        service = ServiceProcess(["--workers", "1", "--recording", str(path.resolve())], log=Path(folder) / "service.log")
        try:
            with Console(stderr=True).status("starting the service"):
                service.wait_until_ready()
            _show(f"{service.http}/#/recording", args.browser)
            print("Ctrl-C ends it", flush=True)
            signal.pause()
        except ServiceFailed as error:
            print(f"ddakf view: {error}", file=sys.stderr)
            return EXIT_FAILED
        except KeyboardInterrupt:
            return 0
        finally:
            service.stop()
    return 0


def _show(address: str, in_browser: bool) -> None:
    print(address, flush=True)
    if in_browser:
        webbrowser.open(address)
