"""Loading of the kernels before the first frame. numba reads or compiles a kernel where it is first called."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np

from ddakf.config import Config
from ddakf.mesh import Mesh

_loaded: set[tuple] = set()  # kinds of stages whose kernels this process has, see load_kernels
STEPS = ((0.0, 0.0), (0.03, 1 / 30), (0.5, 1.5))  # m, s: at rest, in fast motion, elsewhere after a gap
ASTRAY = np.array([[0.0, 0.1, 0.3], [0.2, 0.2, 0.2], [-0.2, 0.3, 0.1]])  # m, what a filter removes


def load_kernels(tracker: Callable, config: Config, with_body: bool) -> None:
    """Loads the kernels that a tracker calls, by tracking a small tube with the same kinds of stages; once for these.

    Without it the first frame of a process waits for them: a tenth of a second to one second from the cache, minutes where they
    are compiled. Those for colours, and for a template that is finer than its working mesh, wait for their first use. While one
    thread loads them, the frames of another wait.

    Args:
        tracker: the class ``ddakf.Tracker``.
        config: of the tracker. The tube is tracked with the defaults of its stages, so that no value makes this dear.
        with_body: whether it is given the body.
    """
    kinds = {field.name: type(getattr(config, field.name)) for field in fields(config)}
    kind = (with_body, *kinds.values())
    if kind in _loaded:
        return
    _loaded.add(kind)
    usual = Config(**{name: stage() for name, stage in kinds.items()})
    garment, body = tube(0.1, 12, 8), tube(0.09, 10, 8)
    cloud = np.concatenate([garment.vertices[garment.faces].mean(axis=1), garment.vertices, ASTRAY])
    one, opposite = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0]])
    for eye in (None, one, np.where(cloud[:, 2:] > 0.0, one, opposite)):
        tracked = tracker(garment, body=body if with_body else None, config=usual)
        tracked.reset(vertices=garment.vertices)
        for shift, timestamp in STEPS:
            pose = body.vertices if with_body else None
            tracked.step(cloud + [shift, 0, 0], timestamp=timestamp, sensor_origin=eye, body_vertices=pose)


def tube(radius: float, around: int, along: int) -> Mesh:
    """An open tube about the vertical, with edges of 5 cm along it; radius in metres."""
    angle = np.arange(around) * 2 * np.pi / around
    ring = np.stack([radius * np.cos(angle), np.zeros(around), radius * np.sin(angle)], axis=1)
    vertices = np.concatenate([ring + [0.0, 0.05 * k, 0.0] for k in range(along)])
    faces = []
    for k in range(along - 1):
        for a in range(around):
            i, j = k * around + a, k * around + (a + 1) % around
            faces += [[i, i + around, j], [j, i + around, j + around]]
    return Mesh(vertices, np.array(faces))
