"""Compiles every kernel by tracking a small garment over a small body, with both presets."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def run(progress: Callable[[int, int, str], None]) -> None:
    """See :func:`ddakf.kernels.warm`."""
    from ddakf.config import Config
    from ddakf.tracker import Tracker

    garment, body = _tube(0.22, 12, 10), _tube(0.2, 10, 8)
    cloud = garment.vertices[garment.faces].mean(axis=1)
    cloud = np.concatenate([cloud, garment.vertices])
    eye = np.array([0.0, 0.0, 2.0])
    steps = [
        ("cloud alone", None, Config(), dict(sensor_origin=None)),
        ("one camera and a body", body, Config(), dict(sensor_origin=eye, body_vertices=body.vertices)),
        ("several cameras", None, Config(), dict(sensor_origin=np.tile(eye, (len(cloud), 1)))),
        ("the paper's preset", None, Config.paper(), dict(sensor_origin=None)),
    ]
    for done, (name, skeleton, config, how) in enumerate(steps):
        progress(done, len(steps), name)
        tracker = Tracker(garment, body=skeleton, config=config)
        for k in range(2):
            tracker.step(cloud, timestamp=k / 30.0, **how)
    progress(len(steps), len(steps), "done")


def _tube(radius: float, around: int, along: int):
    from ddakf.mesh import Mesh

    angle = np.arange(around) * 2 * np.pi / around
    ring = np.stack([radius * np.cos(angle), np.zeros(around), radius * np.sin(angle)], axis=1)
    vertices = np.concatenate([ring + [0.0, 0.05 * k, 0.0] for k in range(along)])
    faces = []
    for k in range(along - 1):
        for a in range(around):
            i, j = k * around + a, k * around + (a + 1) % around
            faces += [[i, i + around, j], [j, i + around, j + around]]
    return Mesh(vertices, np.array(faces))
