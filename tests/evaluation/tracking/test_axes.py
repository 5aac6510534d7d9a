"""Axes of a recording: a template of other axes than the points is told how it has to be turned, and no other one is."""

import json
import re

import numpy as np
import pytest

from ddakf import Config, Mesh
from ddakf.data import sample
from ddakf.evaluation.datasets import open_dataset
from ddakf.evaluation.sensors import Sensor
from ddakf.evaluation.tracking import axes
from ddakf.evaluation.tracking.sources import source_of
from ddakf.files import io
from tests.lanes import every

CONFIG = Config()
COUNT = 6


def clouds(folder, rotation, view):
    """A source of the sample's first clouds, turned; its template is as it is."""
    folder.mkdir()
    s, sensor = sample(), Sensor(view, points=4000)
    for k in range(COUNT):
        points, _ = sensor.capture(s, k, np.random.default_rng(k))
        io.write_points(folder / f"{k}.ply", points @ rotation.T)
    io.write_mesh(folder.with_suffix(".ply"), s.template, s.garment_faces)
    return source_of(open_dataset(folder), template=folder.with_suffix(".ply"))


@pytest.mark.parametrize(("up", "turned"), every(3, [("z", "x, -z, y"), ("-y", "x, -y, -z"), ("x", "y, -x, z")]))
def test_a_template_with_another_axis_up_is_told_its_turn(tmp_path, up, turned):
    """Such clouds were recovering at a reliability of 0, without a word of the cause."""
    said = axes.fitting_turn(clouds(tmp_path / "clouds", axes.turn("y", up), "full"), CONFIG)
    assert f"turned to [{turned}] it fits the first points" in said
    assert json.loads(re.search(r"--config '(.*)'$", said)[1]) == {"start": {"up": up}}


@pytest.mark.slow
def test_one_of_the_points_axes_is_not(tmp_path):
    assert axes.fitting_turn(clouds(tmp_path / "clouds", np.eye(3), "full"), CONFIG) == ""


def test_another_garment_is_not(tmp_path):
    """Whatever its turn, it fits badly."""
    source = clouds(tmp_path / "clouds", np.eye(3), "front")
    sheet = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1.0, 0], [1, 1, 0]]), np.array([[0, 1, 2], [1, 3, 2]]))
    object.__setattr__(source, "garment", sheet)
    assert axes.fitting_turn(source, CONFIG) == ""


@pytest.mark.parametrize("before", axes.AXES)
@pytest.mark.parametrize("after", axes.AXES)
def test_a_turn_takes_one_axis_to_the_other(before, after):
    rotation = axes.turn(before, after)
    np.testing.assert_allclose(rotation @ unit(before), unit(after))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3))
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert axes._coordinate(unit(after)) == after


def unit(axis):
    return np.eye(3)["xyz".index(axis[-1])] * (-1.0 if axis.startswith("-") else 1.0)
