"""The command line: exit statuses, one sentence per error, commands from other packages."""

import argparse
import builtins
import json
import os
import signal
import subprocess
import sys
from importlib import metadata

import pytest

from ddakf.commands import cli, doctor
from ddakf.errors import SERVICE_PACKAGES, InvalidArgument


@pytest.fixture
def command(monkeypatch):
    """Runs ``ddakf test ...`` whose work is the given function."""

    def run_with(work, *arguments):
        def register(commands):
            commands.add_parser("test").set_defaults(run=work)

        plugin = argparse.Namespace(name="test", load=lambda: register)
        monkeypatch.setattr(metadata, "entry_points", lambda group: [plugin] if group == cli.GROUP else [])
        return cli.main(["test", *arguments])

    return run_with


def _raises(error):
    def work(arguments):
        raise error

    return work


def test_commands_of_other_packages_run(command, capsys):
    assert command(lambda arguments: print("done")) == 0
    assert capsys.readouterr().out == "done\n"
    assert command(lambda arguments: 3) == 3


def test_errors_are_one_sentence_and_status_2(command, capsys):
    assert command(_raises(InvalidArgument("points", "finite numbers", "nan"))) == 2
    assert capsys.readouterr().err == "ddakf: points: expected finite numbers, got nan\n"


def test_a_full_disk_is_one_sentence(command, capsys):
    def work(arguments):
        with open("/dev/full", "w") as file:
            file.write("x")

    assert command(work) == 2
    assert capsys.readouterr().err == "ddakf: No space left on device\n"


def test_a_reader_that_has_enough_ends_a_command_quietly():
    code = "import sys; from ddakf.commands import cli; sys.exit(cli.main(['evaluate', '--help']))"
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([sys.executable, "-c", code], stdout=write, stderr=subprocess.PIPE, check=False)
    os.close(write)
    assert done.stderr == b""


def test_interrupts_are_status_130(command, capsys):
    assert command(_raises(KeyboardInterrupt())) == 130
    assert capsys.readouterr().err == "ddakf: interrupted\n"


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_command_that_is_ended_by_a_signal_saves_what_it_has(name):
    code = f"""
import os, signal, sys, time
signal.signal(signal.{name}, signal.SIG_DFL)
from ddakf.commands import cli

def run(arguments):
    try:
        os.kill(os.getpid(), signal.{name})
        time.sleep(20)
    except KeyboardInterrupt:
        print("saved")
        raise

cli._parser = lambda: type("P", (), {{"parse_args": lambda self, argv: type("A", (), {{"run": staticmethod(run)}})}})()
sys.exit(cli.main([]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (128 + getattr(signal, name), "saved\n", "")


def test_a_signal_that_is_ignored_stays_ignored(command):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert command(lambda arguments: os.kill(os.getpid(), signal.SIGHUP)) == 0
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize(
    ("package", "how"),
    [
        ("fastapi", f"; {SERVICE_PACKAGES}"),
        ("torch.nn", ": pip install 'ddakf[learned]'"),
        ("ray", ": pip install 'ddakf[ray]'"),
    ],
)
def test_a_missing_package_is_named_when_the_command_runs(command, capsys, package, how):
    assert command(_raises(ModuleNotFoundError(f"No module named '{package}'", name=package))) == 2
    assert f"{package}, which is not installed{how}" in capsys.readouterr().err


def test_a_missing_package_is_named_when_the_command_cannot_even_load(monkeypatch, capsys):
    def load():
        raise ModuleNotFoundError("No module named 'grpc'", name="grpc")

    plugin = argparse.Namespace(name="serve", load=load)
    monkeypatch.setattr(metadata, "entry_points", lambda group: [plugin])
    assert cli.main(["serve", "--port", "7", "--help"]) == 2
    assert capsys.readouterr().err == f"ddakf: serve needs grpc, which is not installed; {SERVICE_PACKAGES}\n"
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    assert "serve" in capsys.readouterr().out


def test_other_faults_of_the_program_are_not_hidden(command):
    with pytest.raises(ZeroDivisionError):
        command(_raises(ZeroDivisionError()))


def test_version_and_usage(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith("ddakf ")
    with pytest.raises(SystemExit) as ended:
        cli.main([])
    assert ended.value.code == 2


def test_doctor_reports_packages_open3d_cache_and_ports(capsys):
    assert cli.main(["doctor", "--json"]) == 0
    findings = json.loads(capsys.readouterr().out)
    assert findings["packages"]["numpy"]
    assert findings["open3d"] == "ok" or "install" in findings["open3d"]
    assert findings["kernels"]["directory"].endswith("kernels")
    assert len(findings["ports"]) == 2
    assert cli.main(["doctor"]) == 0
    assert "kernel cache" in capsys.readouterr().out


def test_doctor_without_open3d_prints_the_extra(monkeypatch, capsys):
    def refuse(name, *rest, original=builtins.__import__):
        if name == "open3d":
            raise ModuleNotFoundError("No module named 'open3d'")
        return original(name, *rest)

    monkeypatch.setattr(builtins, "__import__", refuse)
    assert "ddakf[evaluation]" in doctor.examine()["open3d"]
    assert cli.main(["doctor"]) == 0
    assert "ddakf[evaluation]" in capsys.readouterr().out.replace("\n", "")


def test_doctor_warms_with_progress(monkeypatch):
    calls = []

    def warm(progress):
        for done in range(4):
            progress("loading", done, 3, f"kernel {done}")
            calls.append(done)

    monkeypatch.setattr("ddakf.commands.warmup.warm", warm)
    assert cli.main(["doctor", "--warm", "--json"]) == 0
    assert calls == [0, 1, 2, 3]


def test_ports_in_use_are_seen():
    import socket

    with socket.socket() as listener:
        listener.bind((doctor.LOOPBACK, 0))
        listener.listen()
        assert not doctor._is_free(listener.getsockname()[1])
