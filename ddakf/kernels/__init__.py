"""Compiled kernels: numba, one module per stage, same stem. Importing this package fixes where compiled code is cached.

numba keys a cached function by its own file only, so a change in a function that it inlines from another file would go
unnoticed; the cache directory therefore carries a hash of all kernel sources. The named tuples that kernels take are declared
beside them, so that the hash covers their fields.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from pathlib import Path

import numba


def _cache_directory() -> Path:
    """The folder of compiled kernels; one in the temporary directory replaces it where it cannot be written to."""
    digest = hashlib.sha256(numba.__version__.encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.name.encode())
        digest.update(source.read_bytes())
    name = f"kernels-{digest.hexdigest()[:16]}"
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    wanted = Path(os.environ.get("DDAKF_KERNEL_CACHE") or Path(home, "ddakf"), name)
    if _writable(wanted):
        return wanted
    spare = Path(tempfile.gettempdir(), f"ddakf-{os.getuid() if hasattr(os, 'getuid') else 'cache'}", name)
    if wanted.is_dir() and not spare.is_dir():  # compiled beforehand, as in a read-only image
        shutil.copytree(wanted, spare)
    return spare


def _writable(directory: Path) -> bool:
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            return True
    except OSError:
        return False


CACHE_DIRECTORY = _cache_directory()
numba.config.CACHE_DIR = str(CACHE_DIRECTORY)
# rows padded to four numbers become one vector: without it the sums over one-rings take twice as long
numba.config.SLP_VECTORIZE = 1

FAST = {"reassoc", "contract", "arcp", "nsz"}  # sums in any order and fused; what is not finite stays so, to be refused later
