"""A world whose vertical is another axis: the same answers, turned."""

import dataclasses

import numpy as np
import pytest

from ddakf import Config, Mesh, Tracker
from ddakf.config import Start
from ddakf.errors import InvalidConfig
from tests.stages.scenes import FPS, about, inner_body, rms, scan, tube

MESH = tube()
BODY = inner_body(MESH)
UP = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1], "-x": [-1, 0, 0], "-y": [0, -1, 0], "-z": [0, 0, -1]}


@pytest.mark.parametrize("axis", UP)
def test_the_rotation_turns_the_axis_upward(axis):
    turn = Start(up=axis).to_y_up
    np.testing.assert_array_equal(turn @ UP[axis], UP["y"])
    np.testing.assert_array_equal(turn @ turn.T, np.eye(3))
    assert np.linalg.det(turn) == 1.0


@pytest.mark.parametrize("wrong", ["up", "Y", None, 2, ["y"]])
def test_another_word_is_refused(wrong):
    with pytest.raises(InvalidConfig, match="x, y, z, -x, -y, -z"):
        Config.from_dict({"start": {"up": wrong}})


def tracked(axis: str, angle: float) -> list[np.ndarray]:
    """Vertices after each frame, turned back to a world with y up, of a worn tube that starts elsewhere and leans over."""
    turn = Start(up=axis).to_y_up.T
    garment, body = (Mesh(mesh.vertices @ turn.T, mesh.faces) for mesh in (MESH, BODY))
    tracker = Tracker(garment, body=body, config=dataclasses.replace(Config(), start=Start(up=axis)))
    found = []
    for k in range(1, 9):
        pose = about([0.0, 1.0, 0.0], angle) @ about([1.0, 0.0, 0.0], 0.05 * k)
        points = scan(MESH.vertices @ pose.T + [0.4, 0.1, 0.0], MESH, seed=k)
        under = (BODY.vertices @ pose.T + [0.4, 0.1, 0.0]) @ turn.T
        found.append(tracker.step(points @ turn.T, timestamp=k / FPS, body_vertices=under).vertices @ turn)
    return found


@pytest.mark.parametrize("axis", ["z", "-y", "x"])
def test_a_garment_is_found_and_followed_alike_in_every_world(axis):
    for turned, upright in zip(tracked(axis, 2.0), tracked("y", 2.0), strict=True):
        assert rms(turned - upright) < 2e-3  # the cells of the grids lie otherwise


def test_the_search_turns_about_the_vertical():
    """About another axis it does not find a garment that has turned by 50 degrees."""
    turn, pose = Start(up="z").to_y_up.T, about([0.0, 1.0, 0.0], 0.9)
    truth = (MESH.vertices @ pose.T + [0.4, 0.0, 0.0]) @ turn.T
    points, off = scan(truth, MESH), {}
    for axis in ("z", "y"):
        config = dataclasses.replace(Config(), start=Start(up=axis))
        tracker = Tracker(Mesh(MESH.vertices @ turn.T, MESH.faces), config=config)
        for k in range(1, 7):
            result = tracker.step(points, timestamp=k / FPS)
        off[axis] = rms(result.vertices - truth)
    assert off["z"] < 0.05
    assert off["y"] > 2.0 * off["z"]
