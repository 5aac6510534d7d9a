"""Licences of the packages in the images: ``licences.py`` lists them and fails where one is not in the list of allowed.

The allowed ones let a program under Apache-2.0 use the package as it is.
"""

from __future__ import annotations

import re
import sys
from importlib import metadata
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from weight import closure

EXTRAS = ["service", "postgres", "tracing", "s3", "ray"]  # of the image that has most
ALLOWED = {
    "0BSD", "Apache-2.0", "BSD", "BSD-2-Clause", "BSD-3-Clause", "BSL-1.0", "CC0-1.0", "HPND", "ISC", "LGPL-3.0-only",
    "LLVM-exception", "MIT", "MIT-CMU", "MPL-2.0", "PSF-2.0", "Python-2.0", "Unlicense", "Zlib",
}  # fmt: skip
# Sentences and classifiers of packages that do not state an SPDX expression
NAMES = {
    "apache": "Apache-2.0", "apache 2.0": "Apache-2.0", "apache license 2.0": "Apache-2.0",
    "apache license, version 2.0": "Apache-2.0",
    "apache software license": "Apache-2.0", "bsd": "BSD", "bsd license": "BSD", "bsd 3-clause license": "BSD-3-Clause",
    "3-clause bsd license": "BSD-3-Clause", "new bsd license": "BSD-3-Clause", "new bsd": "BSD-3-Clause",
    "mit license": "MIT", "the mit license (mit)": "MIT", "gnu lgpl": "LGPL-3.0-only",
    "gnu lesser general public license v3 (lgplv3)": "LGPL-3.0-only", "mozilla public license 2.0 (mpl 2.0)": "MPL-2.0",
    "python software foundation license": "PSF-2.0", "apache license": "Apache-2.0",
}  # fmt: skip
NO_LICENCE = ("osi approved", "dual license")  # the classifiers name them


def main() -> int:
    """Prints package, version and licence; returns 1 where one is not allowed."""
    refused = []
    for name in sorted(closure(EXTRAS)):
        found = licences(name)
        if not found or not found <= ALLOWED:
            refused.append(name)
        print(f"{name:45} {metadata.version(name):14} {' '.join(sorted(found)) or 'unknown'}")
    if refused:
        print(f"not in the list of allowed licences: {', '.join(refused)}", file=sys.stderr)
    return 1 if refused else 0


def licences(name: str) -> set[str]:
    """SPDX identifiers of an installed distribution; empty where it states none."""
    about = metadata.metadata(name)
    if expression := about.get("License-Expression"):
        return set(re.findall(r"[\w.+-]+", re.sub(r"\b(AND|OR|WITH)\b", " ", expression)))
    stated = [
        about.get("License") or "",
        *(text.rpartition(" :: ")[2] for text in about.get_all("Classifier", []) if "License ::" in text),
    ]
    found = set()
    for text in (text.strip() for text in stated):
        if text in ALLOWED:
            found.add(text)
        elif (known := NAMES.get(text.lower())) is not None:
            found.add(known)
        elif "\n" not in text and text and text.lower() not in NO_LICENCE:
            found.add(text)
    return found


if __name__ == "__main__":
    sys.exit(main())
