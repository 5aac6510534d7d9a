"""The boundary of a step: what is refused, with which sentence, and what is let through unchanged."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddakf.errors import InvalidFrame
from ddakf.stages import frame_input
from ddakf.types import FrameInput
from tests.physics.shapes import ball

BODY = ball(1, 0.2)
CLOUD = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
MANY = np.random.default_rng(0).normal(size=(65, 3))


def checked(points=CLOUD, timestamp=1.0, sensor_origin=None, body_vertices=None, last=0.5, body=BODY):
    return frame_input.check(FrameInput(points, timestamp, sensor_origin, body_vertices), last, body)


def spoilt(value, shape=(50, 3)):
    """Numbers, one of which is ``value``."""
    array = np.zeros(shape)
    array[7, 1] = value
    return array


BAD = {
    "points that are not a number": (dict(points=spoilt(np.nan)), "points", "finite", "1 bad rows, the first at 7"),
    "infinite points": (dict(points=spoilt(-np.inf)), "points", "finite", "the first at 7"),
    "points kilometres away": (dict(points=spoilt(2e4)), "points", "within 10000", "the first at 7"),
    "points of two coordinates": (dict(points=CLOUD[:, :2]), "points", "(N, 3)", "(50, 2)"),
    "points in a row": (dict(points=CLOUD.ravel()), "points", "(N, 3)", "(150,)"),
    "points in a cube": (dict(points=CLOUD[None]), "points", "(N, 3)", "(1, 50, 3)"),
    "one number": (dict(points=3.0), "points", "(N, 3)", "()"),
    "text": (dict(points=CLOUD.astype(str)), "points", "numbers", "dtype <U"),
    "truth values": (dict(points=CLOUD > 0), "points", "numbers", "dtype bool"),
    "complex numbers": (dict(points=CLOUD.astype(complex)), "points", "numbers", "dtype complex"),
    "objects": (dict(points=np.full((2, 3), None)), "points", "numbers", "dtype object"),
    "rows of different lengths": (dict(points=[[0, 0, 0], [1, 2]]), "points", "(N, 3)", "different lengths"),
    "nothing": (dict(points=None), "points", "numbers", "NoneType"),
    "an iterator": (dict(points=iter(CLOUD)), "points", "numbers", "iterator"),
    "five million points": (
        dict(points=np.zeros((5_000_000, 3), np.float32)), "points", "at most 1000000 points", "5000000"),
    "time that is text": (dict(timestamp="now"), "timestamp", "seconds", "now"),
    "no time": (dict(timestamp=None), "timestamp", "seconds", "None"),
    "time that is not a number": (dict(timestamp=float("nan")), "timestamp", "finite", "nan"),
    "endless time": (dict(timestamp=float("inf")), "timestamp", "finite", "inf"),
    "time that is too large an integer": (dict(timestamp=10**400), "timestamp", "seconds", "10"),
    "time standing still": (dict(timestamp=0.5), "timestamp", "later than the last frame's 0.5", "0.500000"),
    "a second frame of the same moment": (dict(timestamp=0.5 + 1e-9), "timestamp", "later than", "0.500000"),
    "time beyond reason": (dict(timestamp=1e300), "timestamp", "seconds within", "1e+300"),
    "time going backwards": (dict(timestamp=0.25), "timestamp", "later than", "0.250000"),
    "an origin of two coordinates": (dict(sensor_origin=[0.0, 1.0]), "sensor_origin", "(3,) or (50, 3)", "(2,)"),
    "origins of too few points": (dict(sensor_origin=np.zeros((49, 3))), "sensor_origin", "(50, 3)", "(49, 3)"),
    "an origin of its own for each point": (
        dict(points=MANY, sensor_origin=MANY), "sensor_origin", "at most 64 sensors", "65 distinct origins"),
    "an origin that is not a number": (dict(sensor_origin=[0, np.nan, 0]), "sensor_origin", "finite", "nan"),
    "an origin by name": (dict(sensor_origin="front"), "sensor_origin", "numbers", "str"),
    "an origin of text": (dict(sensor_origin=["a", "b", "c"]), "sensor_origin", "numbers", "dtype"),
    "an origin of truth values": (dict(sensor_origin=[True, False, True]), "sensor_origin", "numbers", "dtype"),
    "a ragged origin": (dict(sensor_origin=[[0.0], [0.0, 1.0]]), "sensor_origin", "(3,)", "different lengths"),
    "a body of another size": (dict(body_vertices=BODY.vertices[1:]), "body_vertices", "(18, 3), as declared", "(17, 3)"),
    "a body that is not a number": (dict(body_vertices=spoilt(np.nan, (18, 3))), "body_vertices", "finite", "at 7"),
    "a body of another shape": (dict(body_vertices=np.zeros((18, 2))), "body_vertices", "(N, 3)", "(18, 2)"),
    "no body vertices at all": (dict(body_vertices=np.zeros((0, 3))), "body_vertices", "(18, 3)", "(0, 3)"),
    "a body in millimetres": (dict(body_vertices=1000 * BODY.vertices), "body_vertices", "m in size, as declared", "m"),
    "a body without declaration": (
        dict(body_vertices=BODY.vertices, body=None), "body_vertices", "made without a body", "array"),
}  # fmt: skip


@pytest.mark.parametrize("what", list(BAD))
def test_bad_input_is_refused_with_the_field_what_was_expected_and_what_came(what):
    how, field, expected, got = BAD[what]
    with pytest.raises(InvalidFrame) as refusal:
        checked(**how)
    error = refusal.value
    assert error.field == field
    assert expected in error.expected
    assert got in error.got
    assert str(error) == f"{field}: expected {error.expected}, got {error.got}"
    assert "\n" not in str(error)
    assert len(str(error)) < 250


@pytest.mark.parametrize(
    "points",
    [CLOUD, CLOUD.astype(np.float64), CLOUD.tolist(), CLOUD[::-1], np.asfortranarray(CLOUD), CLOUD.astype(">f4"),
     CLOUD.astype(np.float16), np.arange(150).reshape(50, 3), np.arange(150, dtype=np.uint8).reshape(50, 3)],
    ids=["float32", "float64", "list", "reversed", "fortran", "big-endian", "float16", "int64", "uint8"],
)  # fmt: skip
def test_any_real_numbers_become_contiguous_float32(points):
    now = checked(points)
    assert now.points.dtype == np.float32
    assert now.points.flags.c_contiguous
    np.testing.assert_array_equal(now.points, np.asarray(points).astype(np.float32))


@pytest.mark.parametrize("nothing", [[], np.empty((0, 3)), np.empty(0), np.empty((0, 3), int)], ids=str)
def test_an_empty_cloud_is_a_frame_without_points(nothing):
    assert checked(nothing).points.shape == (0, 3)
    assert checked(nothing, sensor_origin=[0.0, 1.0, 2.0]).points.shape == (0, 3)
    assert checked(nothing, sensor_origin=np.empty((0, 3))).sensor_origin is None


@pytest.mark.parametrize("time", [0.75, np.float32(0.75), np.int64(1), 1, 1.7e9, 0.50001])
def test_any_later_time_is_taken(time):
    assert checked(timestamp=time).timestamp == float(time)


def test_a_time_that_stands_still_is_refused_also_where_microseconds_are_below_its_digits():
    with pytest.raises(InvalidFrame, match="later than"):
        checked(timestamp=2e10, last=2e10)


@pytest.mark.parametrize("time", [-5.0, 0.0, 1.7e9])
def test_the_first_frame_may_have_any_time(time):
    assert checked(timestamp=time, last=None).timestamp == time


@pytest.mark.parametrize("origin", [[0, 1, 2], np.zeros(3), np.zeros((50, 3)), (0.0, 1.0, 2.0)], ids=str)
def test_an_origin_or_one_per_point_is_taken(origin):
    now = checked(sensor_origin=origin)
    assert now.sensor_origin.dtype == np.float64
    np.testing.assert_array_equal(now.sensor_origin, origin)


def test_the_body_in_its_declared_size_is_taken():
    now = checked(body_vertices=BODY.vertices.astype(np.float32))
    assert now.body_vertices.dtype == np.float64
    assert checked().body_vertices is None


def test_a_million_points_are_taken():
    assert len(checked(np.zeros((1_000_000, 3), np.float32)).points) == 1_000_000


@given(
    st.recursive(st.none() | st.booleans() | st.floats() | st.text(max_size=3) | st.integers(), lambda x: st.lists(x, max_size=4))
)
@settings(max_examples=150, deadline=None, derandomize=True)
def test_whatever_comes_as_points_is_taken_or_refused_by_name(anything):
    try:
        now = checked(anything)
    except InvalidFrame as refusal:
        fields = refusal.field
    else:
        fields = "points" if np.isfinite(now.points).all() else "not finite"
    assert fields == "points"
