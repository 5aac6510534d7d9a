"""The places of the camera in benchmarks/camera_places.py: what a camera sees from there, and the rows of a short run."""

from __future__ import annotations

from dataclasses import replace

import camera_places
import numpy as np
import pytest
from camera_places import FIRST, PLACES, Place
from conditions import RECORDINGS

from ddakf.evaluation.datasets import collection


@pytest.fixture(scope="module")
def sequence():
    return collection.load(RECORDINGS[-1])


def cloud(sequence, place: Place, frame: int = FIRST):
    return camera_places.seen_from(place, sequence, frame, np.random.default_rng(1))


@pytest.mark.parametrize("name", [name for name, place in PLACES.items() if place.scene is None])
def test_a_place_sees_the_side_of_the_garment_that_faces_it(name, sequence):
    points, eye = cloud(sequence, replace(PLACES[name], shake=0.0, told_off=0.0))
    vertices = sequence.garment_vertices[FIRST]
    towards = eye - vertices.mean(axis=0)
    towards = towards / np.linalg.norm(towards)
    assert len(points) > 400
    assert (points @ towards).mean() > (vertices @ towards).mean() + 0.01


def test_places_are_where_their_names_say(sequence):
    middle = sequence.garment_vertices[0].mean(axis=0)
    away = {name: cloud(sequence, place).sensor_origin - middle for name, place in PLACES.items()}
    assert away["in front"][2] > 1.9
    assert away["behind"][2] < -1.9
    assert away["beside"][0] > 1.9
    assert away["above"][1] > 1.5 > 0 > away["below"][1]
    assert np.linalg.norm(away["near"]) < 1.0 < 4.5 < np.linalg.norm(away["far"])
    later = cloud(sequence, PLACES["on its way around"], FIRST + 45).sensor_origin - middle
    assert later[2] < -1.9


def test_half_of_a_garment_is_outside_of_the_image_or_behind_who_passes(sequence):
    names = "in front", "half outside", "somebody passes"
    front, half, passing = (cloud(sequence, PLACES[name], FIRST + 12).points for name in names)
    assert half[:, 0].min() > front[:, 0].min() + 0.05
    gaps = np.diff(np.sort(passing[:, 0]))
    assert gaps.max() > 0.8 * camera_places.BAND > np.diff(np.sort(front[:, 0])).max()


def test_a_scene_has_the_garment_and_what_its_name_says(sequence):
    names = "in front", "not cut out", "not cut out, in a room", "not cut out, a table in between", "not cut out, somebody beside"
    garment, person, room, table, beside = (cloud(sequence, PLACES[name]).points for name in names)
    assert len(garment) < len(person) < min(len(room), len(beside))
    assert room[:, 2].min() < person[:, 2].min() - 0.3
    assert table[:, 2].max() > person[:, 2].max() + 0.1
    assert beside[:, 0].max() > person[:, 0].max() + 0.6
    # the table hides a part of the garment, the others nothing of it
    seen = [(distance(garment, scene) < 0.03).mean() for scene in (person, room, table, beside)]
    assert min(seen[0], seen[1], seen[3]) > 0.98 > 0.9 > seen[2]


def distance(points, scene):
    """Of some points to the nearest of a scene, metres."""
    from scipy.spatial import cKDTree

    return cKDTree(scene).query(points)[0]


def test_a_mask_that_is_too_narrow_leaves_the_rims_out_and_one_too_wide_has_skin(sequence):
    names = "in front", "cut out too narrowly", "cut out too widely"
    right, narrow, wide = (cloud(sequence, PLACES[name]).points for name in names)
    assert len(narrow) < 0.9 * len(right) < len(right) < 0.95 * len(wide)
    assert narrow[:, 1].min() > right[:, 1].min() + 0.01
    assert (distance(wide, right) > 0.015).mean() > 0.03


@pytest.mark.slow
def test_a_run_has_a_row_for_every_place_and_its_table_a_line():
    rows = [row for body in (False, True) for row in camera_places.run((RECORDINGS[-1], body, 2))]
    assert [row["place"] for row in rows] == [*PLACES, *PLACES]
    assert all(0 < row["rmse_mm"] < 40 for row in rows)
    *lines, empty, last = camera_places.table(rows)
    assert len(lines) == 2 + len(PLACES)
    assert len({line.count("|") for line in lines}) == 1
    assert (empty, last.split(" of ")[0]) == ("", "0")
