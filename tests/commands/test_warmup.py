"""Compiling in advance: what a tracker needs is compiled before its first frame."""

import subprocess
import sys

import numba
import pytest
from numba.core import event

from ddakf.commands import warmup

PROGRAM = """
import importlib, pkgutil
import numpy as np
from numba.core.dispatcher import Dispatcher
from ddakf import Config, Mesh, Tracker, kernels
from ddakf.commands import warmup
from ddakf.first_frame import tube
from ddakf.garment import remeshing

modules = [importlib.import_module(f"ddakf.kernels.{m.name}") for m in pkgutil.iter_modules(kernels.__path__)]


def compiled():
    found = [(m.__name__, name, d) for m in modules for name, d in vars(m).items() if isinstance(d, Dispatcher)]
    return {(module, name, str(s)) for module, name, d in found for s in d.signatures}


said = []
warmup.warm(lambda *step: said.append(step))
before = compiled()
garment, body, eye = tube(0.22, 40, 36), tube(0.2, 20, 30), np.array([0.0, 0.0, 2.0])
cloud = np.concatenate([garment.vertices[garment.faces].mean(axis=1), garment.vertices]) * [1.1, 1.0, 1.1]
for skeleton, how in ((None, {}), (body, {"sensor_origin": eye, "body_vertices": body.vertices})):
    for config in (Config(), Config.paper()):
        tracker = Tracker(garment, body=skeleton, config=config)
        for shift, timestamp in ((0.0, 0.0), (0.03, 0.03), (0.03, 0.06), (0.5, 1.5), (0.5, 1.53)):
            tracker.step(cloud + [shift, 0.0, 0.0], timestamp=timestamp, **how)
        tracker.step(cloud[::9] + [0.5, 0.0, 0.0], timestamp=1.56, **how)
        for count, place in ((500, 0.0), (500, 0.5), (1, 0.0), (0, 0.0)):
            tracker = Tracker(garment, body=skeleton, config=config)
            for points, timestamp in ((cloud, 0.0), (cloud, 0.03), (np.full((count, 3), place), 1.5)):
                tracker.step(points, timestamp=timestamp, **how)
doll = Mesh(0.2 * garment.vertices, garment.faces)  # so small that its cloud is a dense one
for copies in (1, 6):
    dense = np.repeat(0.2 * cloud / [1.1, 1.0, 1.1], copies, axis=0)
    dense += np.random.default_rng(0).normal(scale=0.001, size=dense.shape)
    for how in ({}, {"sensor_origin": eye}):
        tracker = Tracker(doll)
        for shift, timestamp in ((0.0, 0.0), (0.03, 0.03)):
            tracker.step(dense + [shift, 0.0, 0.0], timestamp=timestamp, **how)
Tracker(garment).step(cloud[cloud[:, 2] > 0.0], timestamp=0.0)
fine, _ = remeshing.subdivided(garment, 0.02)
tracker = Tracker(fine, body=body)
for shift, timestamp in ((0.0, 0.0), (0.03, 0.03)):
    result = tracker.step(cloud + [shift, 0.0, 0.0], timestamp=timestamp, sensor_origin=eye, body_vertices=body.vertices)
tracker.predicted(result, 0.02)
print(*sorted(compiled() - before))
print(*said[-1])
"""


@pytest.mark.slow
def test_soft_and_tiny_garments_and_thin_dense_and_coincident_clouds_need_no_kernel_that_is_not_compiled_in_advance():
    run = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    compiled_later, end = run.stdout.splitlines()
    assert compiled_later == ""
    assert end.split(maxsplit=1)[1] == "7 7 done"


def test_a_kernel_that_the_cache_lacks_is_announced_as_compiled():
    said = []
    announcer = warmup._Announcer(lambda *step: said.append(step), 2)
    with event.install_listener("numba:compile", announcer):
        announcer.next_step("one")
        for addend in (1, 2):
            numba.njit(lambda x: x + 1)(addend)
        announcer.next_step("two")
    assert said == [("loading", 0, 2, "one"), ("compiling", 0, 2, "one"), ("compiling", 1, 2, "two")]
