"""``ddakf view``: the dashboard on a recording or on a server, and the route that gives the recording to the page."""

from __future__ import annotations

import argparse
import re
import signal
import subprocess
import sys

import httpx
import pytest
from ddakf_service.commands.view import view
from ddakf_service.settings import Settings
from pydantic import ValidationError

from ddakf.errors import DdakfError, InvalidArgument

from .conftest import TIMEOUT

START = "import argparse, signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)"
PARSE = "from ddakf_service.commands.view_parser import register; p = argparse.ArgumentParser(); register(p.add_subparsers())"
RUN = f"{START}; {PARSE}; a = p.parse_args(); sys.exit(a.run(a))"


def arguments(**given) -> argparse.Namespace:
    return argparse.Namespace(**{"file": None, "server": None, "browser": False} | given)


@pytest.mark.slow
def test_a_file_is_served_with_the_dashboard_until_it_is_interrupted(tmp_path):
    path = tmp_path / "a walk.npz"
    path.write_bytes(b"what a run has written")
    command = [sys.executable, "-c", RUN, "view", str(path), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            address = process.stdout.readline().strip()
            base = address.removesuffix("/#/recording")
            assert base != address
            assert "<title>ddakf</title>" in httpx.get(base, timeout=TIMEOUT).text
            answer = httpx.get(f"{base}/v1/recording", timeout=TIMEOUT)
            assert process.stdout.readline() == "Ctrl-C ends it\n"
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=TIMEOUT)
        finally:
            process.kill()
    assert answer.content == b"what a run has written"
    assert re.search(r"filename\*=utf-8''a%20walk\.npz", answer.headers["content-disposition"])
    assert (process.returncode, "Traceback" in errors) == (0, False)


def test_a_server_without_a_recording_says_so(http):
    answer = http.get("/v1/recording")
    assert (answer.status_code, answer.json()["error"]["name"]) == (404, "NotFound")


def test_the_dashboard_of_a_server_is_named(service, capsys):
    for server in (service.http.removeprefix("http://"), service.http, f"{service.http}/"):
        assert view(arguments(server=server)) == 0
        assert capsys.readouterr().out == f"{service.http}/\n"


def test_the_port_of_grpc_is_not_that_of_the_dashboard(service):
    with pytest.raises(InvalidArgument, match="server: expected the HTTP port"):
        view(arguments(server=service.grpc))


def test_a_server_of_this_machine_is_asked_without_a_proxy(service, monkeypatch):
    for name in ("http_proxy", "https_proxy", "all_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    assert view(arguments(server=service.http)) == 0


def test_what_cannot_be_shown_is_refused(tmp_path):
    other = tmp_path / "notes.txt"
    other.touch()
    for given in ({}, {"file": "a.npz", "server": "host"}, {"file": "nothing.npz"}, {"file": str(other)}, {"server": "a b"}):
        with pytest.raises(InvalidArgument):
            view(arguments(**given))
    with pytest.raises(DdakfError, match="does not answer"):
        view(arguments(server="127.0.0.1:1"))


@pytest.mark.parametrize("name", ["nothing.mcap", "notes.txt"])
def test_a_setting_that_is_no_recording_is_refused(tmp_path, name):
    (tmp_path / "notes.txt").touch()
    with pytest.raises(ValidationError, match="a file that ends in"):
        Settings(recording=str(tmp_path / name))
