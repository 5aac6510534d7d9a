"""Writes the commit, or DDAKF_BUILD, into what is built; everything else about the package is in pyproject.toml."""

import importlib.util
import os
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).parent


class BuildWithCommit(build_py):
    def run(self):
        super().run()
        specification = importlib.util.spec_from_file_location("build_info", ROOT / "service/ddakf_service/build.py")
        module = importlib.util.module_from_spec(specification)
        specification.loader.exec_module(module)
        folder = Path(self.build_lib) / "ddakf_service"
        if not self.editable_mode and folder.is_dir() and (commit := os.environ.get("DDAKF_BUILD") or module.build()):
            (folder / "BUILD").write_text(commit + "\n")


setup(cmdclass={"build_py": BuildWithCommit})
