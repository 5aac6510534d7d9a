"""Cache of compiled kernels: one folder per kernel module and content, shared by all copies of the package on a machine.

numba finds a compiled function by the path of its file and drops it when that file changes. So a second copy of the package would
compile all again, and a change in a function that it inlines from another file would go unnoticed. Here a module's folder has a
digest of the module and of the kernel modules that it imports, directly or not. The digest holds all named tuples of the package
too: a kernel takes tuples of modules that it does not import, and their class name alone tells numba nothing of the fields.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import llvmlite.binding
import numba
from numba.core import caching

KERNELS = Path(__file__).parent
IMPORT = re.compile(r"^from ddakf\.kernels\.(\w+) import ", re.MULTILINE)
NAMED_TUPLE = re.compile(r"^class \w+\(NamedTuple\):\n(?:(?: .*)?\n)*", re.MULTILINE)
COMPILED = "DDAKF_COMPILED_KERNELS"
"""Variable with a folder of caches that were compiled beforehand, as in an image: one for each of the levels."""
LEVELS = {  # LLVM's names, the best first; each has the features of the following ones too
    "x86-64-v4": ("avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"),
    "x86-64-v3": ("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"),
    "x86-64-v2": ("cx16", "popcnt", "sahf", "sse3", "ssse3", "sse4.1", "sse4.2"),
    "generic": (),
}
STANDARD = "UserProvidedCacheLocator,InTreeCacheLocator,UserWideCacheLocator,IPythonCacheLocator,ZipCacheLocator"


def install() -> None:
    """Makes numba use this cache for the kernels. Other functions of the process are cached as before."""
    _use_compiled()
    numba.config.CACHE_LOCATOR_CLASSES = f"{__name__}.KernelLocator,{numba.config.CACHE_LOCATOR_CLASSES or STANDARD}"
    caching.FunctionCache._guard_against_spurious_io_errors = _without_disk


def supported() -> list[str]:
    """The levels that this processor has, the best first."""
    has = llvmlite.binding.get_host_cpu_features()
    names = list(LEVELS)
    return [name for i, name in enumerate(names) if all(has.get(f) for lower in names[i:] for f in LEVELS[lower])]


def _use_compiled() -> None:
    """Chooses the best level that was compiled beforehand and that this processor has; the environment tells child processes."""
    place = os.environ.get(COMPILED)
    if not place or os.environ.get("DDAKF_KERNEL_CACHE") or os.environ.get("NUMBA_CPU_NAME"):
        return
    if level := next((name for name in supported() if Path(place, name).is_dir()), None):
        os.environ |= {"DDAKF_KERNEL_CACHE": str(Path(place, level)), "NUMBA_CPU_NAME": level, "NUMBA_CPU_FEATURES": ""}
        numba.config.CPU_NAME, numba.config.CPU_FEATURES = level, ""


def directory() -> Path:
    """The folder of the modules' folders: of ``DDAKF_KERNEL_CACHE``, or of the user's cache."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(os.environ.get("DDAKF_KERNEL_CACHE") or Path(home, "ddakf"), "kernels")


def folders() -> list[Path]:
    """The existing folders of this version's modules."""
    return [place / name for name in _names().values() for place in {directory(), _spare()} if (place / name).is_dir()]


def digests(package: Path) -> dict[str, str]:
    """By module of a folder of kernels: a digest of its source, of what it imports, and of what all modules share."""
    source = {path.stem: path.read_text(encoding="utf-8") for path in sorted(package.glob("*.py"))}
    imported = {name: {other for other in IMPORT.findall(text) if other in source} for name, text in source.items()}
    shared = [numba.__version__, source["__init__"], *(t for text in source.values() for t in NAMED_TUPLE.findall(text))]
    found = {}
    for name in source:
        needed, waiting = {name}, [name]
        while waiting:
            new = imported[waiting.pop()] - needed
            needed |= new
            waiting += new
        digest = hashlib.sha256("\0".join([*shared, *(source[other] for other in sorted(needed))]).encode())
        found[name] = digest.hexdigest()[:16]
    return found


@cache
def _names() -> dict[str, str]:
    """The name of each module's folder."""
    return {name: f"{name}-{digest}" for name, digest in digests(KERNELS).items()}


class KernelLocator(caching._CacheLocator):
    """Where numba caches a kernel; ``NUMBA_CACHE_LOCATOR_CLASSES`` of numba's reference describes the interface."""

    def __init__(self, py_func, py_file: str):
        self._py_file = py_file  # numba names it in a warning
        self._folder, self._line = _folder(_names()[Path(py_file).stem]), py_func.__code__.co_firstlineno

    @classmethod
    def from_function(cls, py_func, py_file):
        """The locator of a kernel; None for any other function."""
        return cls(py_func, py_file) if Path(py_file).parent == KERNELS else None

    def get_cache_path(self):
        """The module's folder."""
        return str(self._folder)

    def get_source_stamp(self):
        """The folder's name, since it changes with the source."""
        return self._folder.name

    def get_disambiguator(self):
        """The function's line."""
        return str(self._line)


@cache
def _folder(name: str) -> Path:
    """A module's folder; one in the temporary directory replaces it where it cannot be written to."""
    wanted, spare = directory() / name, _spare() / name
    if _writable(wanted) or not (_writable(spare) and _own(spare.parent)):
        return wanted
    if wanted.is_dir():  # compiled beforehand, as in a read-only image
        shutil.copytree(wanted, spare, dirs_exist_ok=True)
    return spare


def _spare() -> Path:
    try:
        return Path(tempfile.gettempdir(), f"ddakf-{os.getuid() if hasattr(os, 'getuid') else 'cache'}", "kernels")
    except FileNotFoundError:  # nothing is writable, as in a container with a read-only root
        return directory()


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _own(folder: Path) -> bool:
    """Whether this user made the folder: what lies in the cache is executed."""
    return not hasattr(os, "getuid") or folder.stat().st_uid == os.getuid()


@contextmanager
def _without_disk(self: caching.FunctionCache) -> Iterator[None]:
    """Compiles without a cache where a kernel's file cannot be read or written (full disk, no rights, damage)."""
    try:
        yield
    except (OSError, EOFError, pickle.UnpicklingError):
        if not isinstance(self._impl.locator, KernelLocator):
            raise
        self.disable()
