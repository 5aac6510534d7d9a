"""ddakf: real-time garment tracking from 3D point clouds (DD-AKF), with calibrated uncertainty and reliability.

Names are imported at their first use: numba takes a quarter of a second, which a program that only asks for an error or the
version does not need.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ddakf import kernels as kernels
    from ddakf.config import Config as Config
    from ddakf.errors import DdakfError as DdakfError
    from ddakf.mesh import Mesh as Mesh
    from ddakf.physics.fabric import Fabric as Fabric
    from ddakf.results import FrameResult as FrameResult
    from ddakf.tracker import Tracker as Tracker

    __version__: str

_MODULES = {
    "Config": "ddakf.config",
    "DdakfError": "ddakf.errors",
    "Fabric": "ddakf.physics.fabric",
    "FrameResult": "ddakf.results",
    "Mesh": "ddakf.mesh",
    "Tracker": "ddakf.tracker",
}
__all__ = [*_MODULES, "__version__", "kernels"]


def __getattr__(name: str):
    if name in _MODULES:
        value = getattr(import_module(_MODULES[name]), name)
    elif name == "kernels":
        value = import_module("ddakf.kernels")
    elif name == "__version__":
        value = _version()
    else:
        raise AttributeError(f"module 'ddakf' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("ddakf")
    except PackageNotFoundError:  # a source tree on the path, not installed
        return "0+unknown"
