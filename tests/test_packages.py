"""What is in the repository is in the distributions: an editable installation would not notice what is missing there."""

import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("folder", [".", "protos", "clients/python"])
def test_every_package_is_distributed(folder):
    settings = tomllib.loads((ROOT / folder / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    places = settings.get("package-dir", {})
    tops = {name.partition(".")[0] for name in settings["packages"]}
    found = set()
    for top in tops:
        place = ROOT / folder / places.get(top, top)
        found |= {".".join((top, *path.parent.relative_to(place).parts)) for path in place.rglob("*.py")}
    assert found == set(settings["packages"])
