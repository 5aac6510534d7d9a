"""Compiles every kernel by tracking a small garment over a small body, with both presets."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from ddakf import kernels
from ddakf.config import Config
from ddakf.files.cache import drop_unused, used
from ddakf.mesh import Mesh
from ddakf.tracker import Tracker


def warm(progress: Callable[[int, int, str], None] | None = None) -> None:
    """Compiles every kernel, or loads it from the cache, by tracking a small garment.

    Args:
        progress: called as ``progress(done, total, name)`` before each step, and at the end with ``done == total``.
    """
    progress = progress or (lambda done, total, name: None)
    garment, body = _tube(0.22, 36, 32), _tube(0.2, 10, 8)  # large enough to have a coarser version
    cloud = garment.vertices[garment.faces].mean(axis=1)
    cloud = np.concatenate([cloud, garment.vertices])
    astray = np.array([[0.0, 0.1, 0.5], [0.3, 0.2, 0.3], [-0.4, 0.3, 0.1]])  # what a filter removes
    eye = np.array([0.0, 0.0, 2.0])
    layers = dataclasses.replace(Config(), physics=dataclasses.replace(Config().physics, self_collision=1e8, strain_sd=1e-4))
    steps = [
        ("cloud alone", None, Config(), dict(sensor_origin=None)),
        ("one camera and a body", body, Config(), dict(sensor_origin=eye, body_vertices=body.vertices)),
        ("several cameras", None, Config(), dict(sensor_origin=np.tile(eye, (len(cloud) + len(astray), 1)))),
        ("soft layers that collide", None, layers, dict(sensor_origin=None)),
        ("the paper's preset", None, Config.paper(), dict(sensor_origin=None)),
    ]
    for done, (name, skeleton, config, how) in enumerate(steps):
        progress(done, len(steps), name)
        tracker = Tracker(garment, body=skeleton, config=config)
        # where it is, 3 cm farther for the coarse level, and elsewhere, which is searched after a gap
        for shift, timestamp in ((0.0, 0.0), (0.03, 1 / 30), (0.5, 1.5)):
            tracker.step(np.concatenate([cloud + [shift, 0, 0], astray]), timestamp=timestamp, **how)
    used(kernels.CACHE_DIRECTORY)
    drop_unused(kernels.CACHE_DIRECTORY.parent.glob("kernels-*"))
    progress(len(steps), len(steps), "done")


def _tube(radius: float, around: int, along: int):
    angle = np.arange(around) * 2 * np.pi / around
    ring = np.stack([radius * np.cos(angle), np.zeros(around), radius * np.sin(angle)], axis=1)
    vertices = np.concatenate([ring + [0.0, 0.05 * k, 0.0] for k in range(along)])
    faces = []
    for k in range(along - 1):
        for a in range(around):
            i, j = k * around + a, k * around + (a + 1) % around
            faces += [[i, i + around, j], [j, i + around, j + around]]
    return Mesh(vertices, np.array(faces))
