import numpy as np
import pytest

from . import fake_server


@pytest.fixture
def service():
    """A fake service, to be told how to behave; ``service.target`` is its address."""
    service = fake_server.FakeService()
    server, service.target = fake_server.start(service)
    yield service
    server.stop(0).wait()


@pytest.fixture
def mesh():
    """Vertices and faces of a square metre."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    return vertices, np.array([[0, 1, 2], [0, 2, 3]])


@pytest.fixture
def frames():
    """Makes n frames of 200 points; frame i is centred at x = i / 100, at i / 30 s."""

    def make(n):
        points = np.random.default_rng(0).uniform(-0.1, 0.1, (200, 3))
        points -= points.mean(axis=0)
        return [(points + np.array([i / 100, 0, 0]), i / 30) for i in range(n)]

    return make
