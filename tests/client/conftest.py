"""Fixtures of the client tests: fake services, outages, meshes, valid and invalid frames."""

import time

import numpy as np
import pytest
from ports import lasting_port

from . import fake_server


class Outage:
    """A service on one port whose server can be stopped and restarted."""

    def __init__(self, service):
        self.service = service
        self.port = lasting_port()
        self.start()

    def start(self):
        self.server, self.target = fake_server.start(self.service, self.port)

    def strike(self, seconds=0.3, forget=0):
        """Closes all connections, loses the last ``forget`` frames, and restarts."""
        self.server.stop(0).wait()
        for session in self.service.sessions.values():
            session.statistics.last_sequence_number -= forget
        time.sleep(seconds)
        self.start()


class Broken:
    """A frame whose property raises an error."""

    timestamp = 0.5

    @property
    def points(self):
        raise KeyError("no depth yet")


RAGGED = [[0.0, 0, 0], [1.0, 0]]
POINTS = np.zeros((2, 3))
BAD_FRAMES = {
    "ragged points": ((RAGGED, 0.5), "points"),
    "points of text": (([["a", "b", "c"]], 0.5), "points"),
    "points of objects": (([[{}, 1, 2]], 0.5), "points"),
    "flat points with an origin": (([0.0, 0, 0], 0.5, [0, 0, 3]), "points"),
    "points of two columns with as many origins": ((POINTS[:, :2], 0.5, POINTS[:, :2]), "points"),
    "ragged origins": ((POINTS, 0.5, RAGGED), "sensor_origin"),
    "an origin of text": ((POINTS, 0.5, "here"), "sensor_origin"),
    "ragged body": ((POINTS, 0.5, None, RAGGED), "body_vertices"),
    "complex time": ((POINTS, np.complex128(1)), "timestamp"),
    "endless time": ((POINTS, 10**5000), "timestamp"),
    "code that fails": (Broken(), "frame"),
}


@pytest.fixture(params=BAD_FRAMES)
def bad_frame(request):
    """A frame that cannot be converted to a message, and the field that the error names."""
    return BAD_FRAMES[request.param]


@pytest.fixture
def service():
    """A fake service, configured by its attributes; ``service.target`` is its address."""
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


def in_one_buffer(frames):
    """The frames as of a camera that writes each into the same memory."""
    buffer = np.empty_like(frames[0][0])
    for points, seconds in frames:
        buffer[:] = points
        yield buffer, seconds


@pytest.fixture
def outage():
    outage = Outage(fake_server.FakeService())
    yield outage
    outage.server.stop(0).wait()
