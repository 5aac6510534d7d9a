"""Containers of an image for tests: with a Docker engine, or from Buildah's storage without one.

Without an engine a container is a process in a mount namespace of its own: the image's files as a read-only root, a folder as the
one volume, the image's user, environment and command.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

_PATIENCE = 60.0  # seconds for an engine's command
VOLUME = "/var/lib/ddakf"


class Image(NamedTuple):
    """What an image says about itself.

    Attributes:
        config: ``Cmd``, ``Env``, ``User``, ``Labels``, ... size: bytes of all files.
    """

    config: dict
    size: int


class Container(Protocol):
    """A running container."""

    pid: int

    def kill(self, number: int) -> None: ...

    def wait(self) -> int: ...

    def log(self) -> str: ...


class Runtime(Protocol):
    """Inspects and runs an image."""

    def inspect(self) -> Image: ...

    def run(self, volume: Path, environment: Mapping[str, str], ports: Sequence[int]) -> Container: ...

    def execute(self, *command: str) -> subprocess.CompletedProcess: ...

    def close(self) -> None: ...


def runtime(image: str, folder: Path) -> Runtime:
    """The runtime of this machine.

    Args:
        folder: for logs.
    """
    if shutil.which("docker") and subprocess.run(["docker", "info"], capture_output=True).returncode == 0:
        return Docker(image)
    return Unpacked(image, folder)


class Docker:
    """A Docker engine."""

    def __init__(self, image: str):
        self._image = image

    def inspect(self) -> Image:
        (found,) = json.loads(_output("docker", "image", "inspect", self._image))
        return Image(found["Config"], found["Size"])

    def run(self, volume: Path, environment: Mapping[str, str], ports: Sequence[int]) -> DockerContainer:
        volume.chmod(0o777)
        options = ["--detach", "--read-only", "--cap-drop", "ALL", "--volume", f"{volume}:{VOLUME}"]
        for name, value in environment.items():
            options += ["--env", f"{name}={value}"]
        for port in ports:
            options += ["--publish", f"127.0.0.1:{port}:{port}"]
        return DockerContainer(_output("docker", "run", *options, self._image).strip())

    def execute(self, *command: str) -> subprocess.CompletedProcess:
        line = ["docker", "run", "--rm", "--read-only", "--entrypoint", command[0], self._image, *command[1:]]
        return subprocess.run(line, capture_output=True, text=True, timeout=_PATIENCE, check=False)

    def close(self) -> None:
        """Nothing stays."""


class DockerContainer:
    """A container of a Docker engine."""

    def __init__(self, name: str):
        self._name = name
        self.pid = int(_output("docker", "inspect", "--format", "{{.State.Pid}}", name))

    def kill(self, number: int) -> None:
        _output("docker", "kill", "--signal", str(number), self._name)

    def wait(self) -> int:
        status = int(_output("docker", "wait", self._name))
        self._log = _output("docker", "logs", self._name, both=True)
        _output("docker", "rm", "--force", self._name)
        return status

    def log(self) -> str:
        return getattr(self, "_log", "") or _output("docker", "logs", self._name, both=True)


class Unpacked:
    """An image of Buildah's storage, mounted; needs root."""

    def __init__(self, image: str, folder: Path):
        images = os.environ.get("DDAKF_IMAGES", "out/images")
        self._buildah = ["buildah", "--storage-driver", "vfs", "--root", f"{images}/store", "--runroot", f"{images}/run"]
        self._image, self._folder = f"localhost/{image}", folder
        self._container = _output(*self._buildah, "from", self._image).strip()
        self._root = Path(_output(*self._buildah, "mount", self._container).strip())
        self._started = 0

    def inspect(self) -> Image:
        found = json.loads(_output(*self._buildah, "inspect", "--type", "image", self._image))
        return Image(found["Docker"]["config"], sum(p.lstat().st_size for p in self._root.rglob("*") if not p.is_dir()))

    def run(self, volume: Path, environment: Mapping[str, str], ports: Sequence[int]) -> UnpackedContainer:
        volume.chmod(0o777)
        self._started += 1
        log = self._folder / f"container-{self._started}.log"
        with log.open("wb") as output:
            command = self._command(volume, environment, self.inspect().config["Cmd"])
            return UnpackedContainer(subprocess.Popen(command, stdout=output, stderr=output, stdin=subprocess.DEVNULL), log)

    def execute(self, *command: str) -> subprocess.CompletedProcess:
        line = self._command(None, {}, command)
        return subprocess.run(line, capture_output=True, text=True, timeout=_PATIENCE, check=False)

    def close(self) -> None:
        _output(*self._buildah, "rm", self._container)

    def _command(self, volume: Path | None, environment: Mapping[str, str], command: Sequence[str]) -> list[str]:
        config, root = self.inspect().config, shlex.quote(str(self._root))
        user, _, group = config["User"].partition(":")
        variables = [*config["Env"], *(f"{name}={value}" for name, value in environment.items())]
        inside = ["chroot", f"--userspec={user}:{group}", f"--groups={group}", str(self._root), *command]
        steps = [f"mount --bind {root} {root}", f"mount --rbind /dev {root}/dev", f"mount --rbind /proc {root}/proc"]
        steps += [f"mount --bind {shlex.quote(str(volume))} {root}{VOLUME}"] if volume else []
        steps += [
            f"mount -o remount,bind,ro {root}",
            f"exec {shlex.join(['env', '-i', *variables, '/usr/sbin/chroot', *inside[1:]])}",
        ]
        return ["unshare", "--mount", "sh", "-euc", "\n".join(steps)]


class UnpackedContainer:
    """A container without an engine."""

    def __init__(self, process: subprocess.Popen, log: Path):
        self._process, self._log, self.pid = process, log, process.pid

    def kill(self, number: int) -> None:
        self._process.send_signal(number)

    def wait(self) -> int:
        return self._process.wait(_PATIENCE)

    def log(self) -> str:
        return self._log.read_text(errors="replace")


def await_ready(is_ready, container: Container, seconds: float) -> float:
    """Seconds until a condition holds."""
    started = time.monotonic()
    while not is_ready():
        assert time.monotonic() < started + seconds, container.log()
        time.sleep(0.02)
    return time.monotonic() - started


def _output(*command: str, both: bool = False) -> str:
    done = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE, check=False)
    assert done.returncode == 0, f"{shlex.join(command)}: {done.stderr}"
    return done.stdout + (done.stderr if both else "")
