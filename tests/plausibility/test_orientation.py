"""Orientation: meshes inside out, clouds seen from the wrong side."""

import dataclasses

import numpy as np
import pytest

from ddakf import Config, Mesh, Tracker
from ddakf.config import Start
from ddakf.plausibility.orientation import HOLLOW, fallen, outward
from tests.stages.scenes import FPS, scan, turn
from tests.tracker_runs import BODY, EYE, SAMPLE, SHIRT, TUBE, WEARER, cloud

MIRRORED = Mesh(TUBE.vertices * [-1.0, 1.0, 1.0], TUBE.faces)


@pytest.mark.parametrize("mesh", [TUBE, SHIRT, WEARER], ids=["tube", "shirt", "body"])
def test_normals_point_outward_whatever_the_pose(mesh):
    value = outward(mesh)
    assert value > 0.2
    moved = Mesh(2.0 * mesh.vertices @ turn(40).T + [1.0, -2.0, 3.0], mesh.faces)
    assert outward(moved) == pytest.approx(value)
    assert outward(Mesh(mesh.vertices * [1.0, 1.0, -1.0], mesh.faces)) == pytest.approx(-value)


def warned(garment, points, origin, frames=7, body=None):
    tracker = Tracker(garment, body=body)
    return [tracker.step(points, timestamp=k / FPS, sensor_origin=origin).warnings for k in range(frames)]


def test_a_mirrored_mesh_is_told():
    found = warned(MIRRORED, scan(MIRRORED.vertices, MIRRORED), None)
    assert [(w.code, w.field) for w in found[-1]] == [("mirrored", "garment")]
    assert "inside out" in found[-1][0].message


def test_a_hollow_garment_that_fits_its_cloud_is_not_told():
    """A curtain that bows away from its sensor."""
    across, height = np.meshgrid(np.linspace(-0.6, 0.6, 31), np.linspace(0.0, 1.2, 31))
    corner = np.arange(30 * 31).reshape(30, 31)[:, :30].ravel()
    faces = np.concatenate([[corner, corner + 1, corner + 31], [corner + 1, corner + 32, corner + 31]], axis=1).T
    curtain = Mesh(np.stack([across, height, 0.5 * across**2], axis=2).reshape(-1, 3), faces)
    assert outward(curtain) < HOLLOW
    assert not any(warned(curtain, scan(curtain.vertices, curtain), (0.0, 0.6, 3.0)))


def test_a_mirrored_body_is_told():
    inside_out = Mesh(BODY.vertices, BODY.faces[:, ::-1])
    found = warned(TUBE, cloud(0), None, body=inside_out)
    assert [(w.code, w.field) for w in found[-1]] == [("mirrored", "body")]
    assert not any(warned(TUBE, cloud(0), None, body=BODY))


def test_a_cloud_seen_from_the_wrong_side_is_told():
    half = cloud(0)
    half = half[half[:, 2] > 0.05]
    found = warned(TUBE, half, EYE * [1, 1, -1])
    assert ("mirrored", "sensor_origin") in [(w.code, w.field) for w in found[-1]]
    assert not any(warned(TUBE, half, EYE))


def test_a_cloud_upside_down_is_told():
    """As of a depth camera whose y points down."""
    points = scan(SHIRT.vertices, SHIRT, 5000)
    (found,) = warned(SHIRT, points * [1, -1, -1], None, 1)
    assert "upside_down" in [warning.code for warning in found]
    for heading in (0, 60, 180):
        assert not any(warned(SHIRT, points @ turn(heading).T + [0.5, 0.0, 0.3], None, 3))


@pytest.mark.parametrize(("garment", "alike"), [(TUBE, True), (SHIRT, False)], ids=["tube", "shirt"])
def test_a_garment_that_fits_as_well_turned_is_told_when_it_is_found(garment, alike):
    points = scan(garment.vertices, garment, 5000) + [0.5, 0.0, 0.3]
    first, *later = warned(garment, points, None, 3)
    assert ["heading_uncertain"] * alike == [warning.code for warning in first]
    assert not any(later)


TOLD = {"y": "", "-y": "head"} | dict.fromkeys(("x", "-x", "z", "-z"), "high")


@pytest.mark.parametrize(("up", "told"), TOLD.items())
def test_a_body_that_does_not_stand_along_the_vertical_is_told(up, told):
    config = dataclasses.replace(Config(), start=Start(up=up))
    tracker = Tracker(SHIRT, body=WEARER, config=config)
    for k in range(5):
        result = tracker.step(SHIRT.vertices, timestamp=k / 30, body_vertices=WEARER.vertices)
    found = {warning.code: warning for warning in result.warnings}
    assert ("wrong_up" in found) == bool(told)
    if told:
        assert found["wrong_up"].field == "config.start.up"
        assert told in found["wrong_up"].message


Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # rows are the axes of a mesh whose z pointed upward


@pytest.mark.parametrize("up", ["y", "-y", "z"])
def test_a_template_whose_height_is_along_another_axis_is_told(up):
    world = Start(up=up).to_y_up.T  # columns are the axes to the right, upward and to the front
    config = dataclasses.replace(Config(), start=Start(up=up))
    tall = SAMPLE.garment_vertices[0]
    tracker, points = Tracker(Mesh(tall @ Z_UP.T @ world.T, SAMPLE.garment_faces), config=config), scan(tall, SHIRT, 5000)
    for k in range(12):
        result = tracker.step((points + [0.5, 0.0, 0.3]) @ world.T, timestamp=k / 30)
    warning = {each.code: each for each in result.warnings}["wrong_up"]
    assert warning.field == "garment"
    axis = "xyz"[np.abs(world[:, 2]).argmax()]
    assert f"m along its {axis}: does that axis of it point upward" in warning.message


@pytest.mark.parametrize("lies", [False, True])
def test_a_template_of_the_right_axes_is_not_told(lies):
    """Also where its wearer lies, so that it is as high as the template is deep, if the start is given."""
    template, cloud = SAMPLE.garment_vertices[0], scan(SAMPLE.garment_vertices[0], SHIRT, 5000)
    turned = Z_UP.T if lies else np.eye(3)
    tracker = Tracker(Mesh(template, SAMPLE.garment_faces))
    if lies:
        tracker.reset(template @ turned.T)
    codes = {warning.code for k in range(12) for warning in tracker.step(cloud @ turned.T, timestamp=k / 30).warnings}
    assert "wrong_up" not in codes


def test_people_stand_upright_with_their_arms_down_and_out():
    for frame in range(0, len(SAMPLE), 10):
        assert fallen(Mesh(SAMPLE.body_vertices[frame], SAMPLE.body_faces), Start().to_y_up) == ""


def test_a_torso_with_its_head_is_no_person_upside_down():
    """It ends at the hips, and most of its surface is below its middle."""
    vertices, faces = WEARER.vertices, WEARER.faces
    hips = np.quantile(SHIRT.vertices[:, 1], 0.05)
    torso, _ = Mesh.cleaned(vertices, faces[(vertices[faces][:, :, 1] > hips).all(axis=1)])
    assert np.ptp(torso.vertices[:, 1]) < 1.0
    assert fallen(torso, Start().to_y_up) == ""
    assert "high" in fallen(torso, Start(up="z").to_y_up)
