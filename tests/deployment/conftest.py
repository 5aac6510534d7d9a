"""Prometheus as the compose file runs it, from Debian's package, with short times."""

from __future__ import annotations

import contextlib
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
import yaml
from ports import lasting_port

from ..service.conftest import eventually

ROOT = Path(__file__).resolve().parents[2]
COMPOSE = yaml.safe_load((ROOT / "docker/compose.yaml").read_text(encoding="utf-8"))
MONITORING = ROOT / "docker/prometheus"


def program(name: str, package: str) -> str:
    """The path of a program; the test skips where it is missing."""
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not installed: apt install {package}")
    return found


class Prometheus:
    """A running Prometheus."""

    def __init__(self, url: str):
        self._client = httpx.Client(base_url=url, timeout=30)

    def alerts(self) -> set[str]:
        """The names of the alerts that fire."""
        found = self._client.get("/api/v1/alerts").raise_for_status().json()["data"]["alerts"]
        return {alert["labels"]["alertname"] for alert in found if alert["state"] == "firing"}

    def values(self, query: str) -> list[float]:
        """The values of a query now."""
        found = self._client.get("/api/v1/query", params={"query": query}).raise_for_status().json()["data"]["result"]
        return [float(series["value"][1]) for series in found]

    def close(self) -> None:
        self._client.close()

    def is_ready(self) -> bool:
        """Whether it answers."""
        try:
            return self._client.get("/-/ready").status_code == 200
        except httpx.TransportError:
            return False


def shortened(rules: str, free: str) -> str:
    """Rules with windows and waits of seconds, and another least number of free bytes."""
    rules = re.sub(r"\[\d+m\]", "[8s]", rules)
    rules = re.sub(r"for: \d+m", "for: 1s", rules)
    assert "< 1e9" in rules
    return rules.replace("< 1e9", f"< {free}")


@contextlib.contextmanager
def prometheus(folder: Path, target: str, key: Path, free: str = "1e9") -> Iterator[Prometheus]:
    """A Prometheus that runs with the arguments, the configuration and the rules of the compose file.

    Args:
        target: "host:port" of the service's HTTP port.
        key: file with the key for the metrics.
        free: bytes below which the disk counts as filling.
    """
    configuration, port = folder / "prometheus", lasting_port()
    configuration.mkdir()
    (configuration / "rules.yml").write_text(shortened((MONITORING / "rules.yml").read_text(), free))
    text = (MONITORING / "prometheus.yml").read_text()
    for old, new in (("ddakf:7702", target), ("/run/ddakf/metrics.key", str(key)), (": 5s", ": 500ms")):
        assert old in text
        text = text.replace(old, new)
    (configuration / "prometheus.yml").write_text(text)
    arguments = [a.replace("/etc/prometheus", str(configuration)) for a in COMPOSE["services"]["prometheus"]["command"]]
    arguments = [a.replace("=/prometheus", f"={folder}/series") for a in arguments]
    command = [program("prometheus", "prometheus"), *arguments, f"--web.listen-address=127.0.0.1:{port}"]
    with (folder / "prometheus.log").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
    running = Prometheus(f"http://127.0.0.1:{port}")
    try:
        eventually(lambda: running.is_ready() or process.poll() is not None)
        assert process.poll() is None, (folder / "prometheus.log").read_text()
        yield running
    finally:
        process.terminate()
        process.wait(60)
        running.close()
