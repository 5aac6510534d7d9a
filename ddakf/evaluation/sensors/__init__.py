"""Sensors: cameras, virtual sensors of garment meshes, and what goes wrong with their clouds."""

from ddakf.evaluation.sensors.camera import Camera, Intrinsics
from ddakf.evaluation.sensors.captured_frame import CapturedFrame, Cloud
from ddakf.evaluation.sensors.virtual_sensor import OUTLIER_MARGIN, Sensor, sample_surface

__all__ = ["OUTLIER_MARGIN", "Camera", "CapturedFrame", "Cloud", "Intrinsics", "Sensor", "sample_surface"]
