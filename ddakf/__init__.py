"""ddakf: real-time garment tracking from 3D point clouds (DD-AKF), with calibrated uncertainty and reliability."""

from importlib.metadata import PackageNotFoundError, version

from ddakf import kernels  # first: it fixes where compiled code is cached
from ddakf.config import Config
from ddakf.errors import DdakfError
from ddakf.mesh import Mesh
from ddakf.physics.fabric import Fabric
from ddakf.tracker import Tracker
from ddakf.types import FrameResult

try:
    __version__ = version("ddakf")
except PackageNotFoundError:  # a source tree on the path, not installed
    __version__ = "0+unknown"

__all__ = ["Config", "DdakfError", "Fabric", "FrameResult", "Mesh", "Tracker", "__version__", "kernels"]
