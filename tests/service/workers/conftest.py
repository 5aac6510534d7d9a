"""A Ray cluster per file of tests, in processes of its own."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from .ray_cluster import RayCluster


@pytest.fixture(scope="module")
def cluster(request) -> Iterator[RayCluster]:
    """A cluster of one node, which has as many processors as the file's ``PROCESSORS``; this process leaves it before its end."""
    ray = pytest.importorskip("ray", reason="ray is not installed: pip install 'ddakf[ray]'")
    cluster = RayCluster(request.module.PROCESSORS)
    try:
        yield cluster
    finally:
        ray.shutdown()
        cluster.end()
