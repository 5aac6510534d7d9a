"""The examples run as they stand, and stay short."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("[0-9][0-9]_*.py"))
SAYS = {
    "01_track_a_cloud": "tracking",
    "02_single_camera_with_body": "with the body",
    "03_stream_to_a_service": "11 frames tracked, 0 dropped, 0 refused",
    "04_async_client": "7 frames",
    "05_your_own_mesh": "2658 of the file's vertices have a new place",
    "06_depth_camera": "the prediction is nearer than the truth of the image",
    "08_record_and_replay": "replayed 8 frames, largest difference of a coordinate: 0 m",
    "09_depth_folder": "of the garment measured, mean sigma",
    "11_submit_a_tracker": "error of the centroid's garment over DD-AKF's",
}

# What an example measures, and what holds of it.
NUMBERS = {
    "01_track_a_cloud": (r"error +([\d.]+) mm", lambda errors: len(errors) > 10 and max(errors) < 8),
    "02_single_camera_with_body": (r"hidden vertices +([\d.]+) mm", lambda hidden: hidden[1] < 0.95 * hidden[0]),
    "04_async_client": (r"(\d+) frames", lambda frames: frames == [7, 7]),
    "11_submit_a_tracker": (r"over DD-AKF's: ([\d.]+)", lambda ratio: ratio[0] > 3),
}


def test_there_is_an_expectation_for_every_example():
    assert [example.stem for example in EXAMPLES] == list(SAYS)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.stem)
def test_an_example_runs_as_it_stands(example, tmp_path):
    ended = subprocess.run([sys.executable, example], cwd=tmp_path, capture_output=True, text=True, timeout=250, check=False)
    assert ended.returncode == 0, ended.stderr
    assert SAYS[example.stem] in ended.stdout
    if number := NUMBERS.get(example.stem):
        pattern, holds = number
        found = [float(text) for text in re.findall(pattern, ended.stdout)]
        assert holds(found), f"{found} in {ended.stdout}"
    assert list(tmp_path.iterdir()) == [], "an example writes only where it is told to"


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.stem)
def test_an_example_fits_on_a_page(example):
    assert len(example.read_text().splitlines()) < 100


NOTEBOOKS = sorted((Path(__file__).parents[1] / "examples").glob("*.ipynb"))


def cells(notebook: Path) -> list[dict]:
    return json.loads(notebook.read_text())["cells"]


def test_a_notebook_runs_cell_after_cell(tmp_path):
    (notebook,) = NOTEBOOKS
    code = "\n".join("".join(cell["source"]) for cell in cells(notebook) if cell["cell_type"] == "code")
    environment = os.environ | {"MPLBACKEND": "Agg"}
    command = [sys.executable, "-W", "ignore:FigureCanvasAgg", "-c", code]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=250, check=False, env=environment)
    assert ended.returncode == 0, ended.stderr
    assert [line.partition(":")[0] for line in ended.stdout.splitlines()] == ["seen", "half hidden"]
    assert list(tmp_path.iterdir()) == []


def test_a_notebook_is_stored_without_outputs():
    (notebook,) = NOTEBOOKS
    for cell in cells(notebook):
        if cell["cell_type"] == "code":
            assert (cell["outputs"], cell["execution_count"]) == ([], None)
