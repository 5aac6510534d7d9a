"""Compiling in advance: what a tracker needs is compiled before its first frame."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

PROGRAM = """
import importlib, pkgutil
import numpy as np
from numba.core.dispatcher import Dispatcher
from ddakf import Config, Tracker, kernels
from ddakf.commands import warmup

modules = [importlib.import_module(f"ddakf.kernels.{m.name}") for m in pkgutil.iter_modules(kernels.__path__)]


def compiled():
    found = [(m.__name__, name, d) for m in modules for name, d in vars(m).items() if isinstance(d, Dispatcher)]
    return {(module, name, str(s)) for module, name, d in found for s in d.signatures}


warmup.warm()
before = compiled()
garment, body, eye = warmup._tube(0.22, 40, 36), warmup._tube(0.2, 20, 30), np.array([0.0, 0.0, 2.0])
cloud = np.concatenate([garment.vertices[garment.faces].mean(axis=1), garment.vertices]) * [1.1, 1.0, 1.1]
for skeleton, how in ((None, {}), (body, {"sensor_origin": eye, "body_vertices": body.vertices})):
    for config in (Config(), Config.paper()):
        tracker = Tracker(garment, body=skeleton, config=config)
        for shift, timestamp in ((0.0, 0.0), (0.03, 0.03), (0.03, 0.06), (0.5, 1.5), (0.5, 1.53)):
            tracker.step(cloud + [shift, 0.0, 0.0], timestamp=timestamp, **how)
        tracker.step(cloud[::9] + [0.5, 0.0, 0.0], timestamp=1.56, **how)
print(*sorted(compiled() - before))
"""


def test_a_large_soft_garment_and_a_thin_cloud_need_no_kernel_that_is_not_compiled_in_advance():
    run = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == ""
