"""The kernels are loaded before the first frame: a process that has a tracker loads none while it tracks."""

import subprocess
import sys

import pytest

from tests.lanes import every

SCRIPT = """
import sys

import numpy as np
from numba.core.registry import CPUDispatcher

import ddakf
from ddakf import data
from ddakf.evaluation.sensors import Sensor


def loaded():
    modules = [module for name, module in sys.modules.items() if name.startswith("ddakf.kernels.")]
    kernels = {id(value): value for module in modules for value in vars(module).values() if isinstance(value, CPUDispatcher)}
    return {(kernel.__name__, signature) for kernel in kernels.values() for signature in kernel.signatures}


view, with_body, preset = sys.argv[1], sys.argv[2] == "True", sys.argv[3]
sequence, sensor, rng = data.sample(), Sensor(view, 4000), np.random.default_rng(1)
clouds = [sensor.capture(sequence, k, rng) for k in range(1, 5)]
body = ddakf.Mesh(sequence.body_vertices[0], sequence.body_faces) if with_body else None
config = getattr(ddakf.Config, preset)() if preset else None
tracker = ddakf.Tracker(ddakf.Mesh(sequence.template, sequence.garment_faces), body=body, config=config)
tracker.reset(vertices=sequence.garment_vertices[0])
before = loaded()
for k, cloud in enumerate(clouds, 1):
    pose = sequence.body_vertices[k] if with_body else None
    tracker.step(cloud.points, timestamp=k / 30, sensor_origin=cloud.sensor_origin, body_vertices=pose)
print(*sorted(f"{name} {signature}" for name, signature in loaded() - before), sep="\\n")
"""


@pytest.mark.parametrize(
    ("view", "with_body", "preset"),
    every(3, [("front", True, ""), ("full", False, ""), ("front", False, ""), ("ring4", False, ""), ("full", False, "paper")]),
)
def test_no_frame_loads_a_kernel(view, with_body, preset):
    command = [sys.executable, "-c", SCRIPT, view, str(with_body), preset]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not done.stdout.split(), done.stdout
