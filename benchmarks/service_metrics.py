"""Metrics of a service of this machine."""

from __future__ import annotations

import urllib.request

from ddakf_service.commands.service_process import ServiceProcess

_PATIENCE = 30.0  # s
_DIRECTLY = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # a proxy of the environment is not for this machine


def metrics_of(process: ServiceProcess) -> dict[str, float]:
    """The value of every series, by its name with its labels."""
    with _DIRECTLY.open(f"{process.http}/metrics", timeout=_PATIENCE) as answer:
        lines = answer.read().decode().splitlines()
    return {line.rpartition(" ")[0]: float(line.rpartition(" ")[2]) for line in lines if not line.startswith("#")}
