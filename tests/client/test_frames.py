"""Frames: conversion to messages, and refused frames."""

from types import SimpleNamespace

import numpy as np
import pytest
from ddakf_api.codec import CODECS, DracoDecoder, decode, decode_colors, decode_depth
from ddakf_api.errors import CodecError, InvalidArgument, InvalidFrame
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import Frame
from ddakf_client.exchange import Plan
from ddakf_client.frames import held, to_message
from ddakf_client.watch import watch_request

DEPTH = np.arange(12, dtype=np.uint16).reshape(3, 4)
LENS = (100.0, 101.0, 1.5, 1.0)
POSE = np.array([[0.0, 0, 1, 4], [0, 1, 0, 5], [-1, 0, 0, 6]])


def message(frame: object, **options) -> pb.Frame:
    return to_message(Frame.of(frame), 1, "morton-zstd", 0.0005, **options)


@pytest.mark.parametrize("codec", ["none", "zstd", "png", "rvl"])
def test_a_depth_image_is_sent_as_it_is(codec):
    mask, confidence = DEPTH > 3, (20 * DEPTH).astype(np.uint8)
    colors = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)
    more = {"mask": mask, "confidence": confidence, "min_confidence": 120, "depth_scale": 0.01, "colors": colors}
    sent = message(Frame(timestamp=1.0, depth=DEPTH, intrinsics=LENS, pose=POSE, **more), depth_codec=codec)
    assert sent.WhichOneof("payload") == "depth_image"
    assert not sent.sensors
    back = decode_depth(sent.depth_image, max_pixels=12)
    assert np.allclose(back.depth, DEPTH * 0.01)
    assert np.array_equal(back.keep, mask & (confidence >= 120))
    assert (back.intrinsics, back.pose.tolist()) == (LENS, POSE.tolist())
    assert np.array_equal(back.colors, colors)


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("sensors", [1, 3])
def test_every_point_keeps_its_color_whatever_the_order_is(codec, sensors):
    rng = np.random.default_rng(0)
    points, colors = rng.uniform(0, 1, (50, 3)), rng.integers(0, 256, (50, 3), np.uint8)
    origin = rng.permutation(np.arange(50) % sensors)[:, None] * np.ones(3)
    sent = to_message(Frame(points, 1.0, origin, colors=colors), 1, codec, 1e-4).point_cloud
    back = decode(sent, max_points=50, draco_decoder=DracoDecoder(50) if codec == "draco" else None)
    nearest = np.square(back[:, None] - points).sum(axis=2).argmin(axis=1)
    assert np.array_equal(decode_colors(sent), colors[nearest])


@pytest.mark.parametrize(
    "colors", [np.zeros((2, 3), np.uint8), np.zeros((3, 3)), np.zeros(9, np.uint8), "red", [[0, 0, 0], [0, 0]]], ids=str
)
def test_colors_of_another_shape_or_type_are_refused(colors):
    with pytest.raises(CodecError, match=r"^colors: expected uint8 of shape \(3, 3\), got ") as refusal:
        message(Frame(np.zeros((3, 3)), 1.0, colors=colors))
    assert refusal.value.field == "colors"


def test_received_colors_of_another_length_are_refused_with_the_field():
    sent = message(Frame(np.zeros((3, 3)), 1.0, colors=np.zeros((3, 3), np.uint8))).point_cloud
    sent.colors = sent.colors[1:]
    with pytest.raises(CodecError, match="9 bytes, 3 for each of the 3 points, got 8 bytes") as refusal:
        decode_colors(sent)
    assert refusal.value.field == "point_cloud.colors"


def test_a_homogeneous_pose_is_accepted():
    square = np.vstack([POSE, [0, 0, 0, 1]])
    sent = message(Frame(timestamp=1.0, depth=DEPTH, intrinsics=LENS, pose=square))
    assert np.array_equal(np.reshape(sent.depth_image.pose.matrix, (3, 4)), POSE)


def test_an_object_may_have_any_of_the_attributes():
    camera = SimpleNamespace(timestamp=2.0, depth=DEPTH, intrinsics=LENS, display_time=2.1, exposure=0.01)
    assert message(camera).display_time == 2.1
    cloud = SimpleNamespace(timestamp=2.0, points=np.zeros((1, 3)), body_vertices=np.zeros((2, 3)))
    assert len(message(cloud).body_vertices) == 24


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("points", [[], (), np.empty(0), np.empty((0, 3)), np.empty((3, 0), np.float32)], ids=repr)
def test_any_empty_array_is_a_frame_without_measurements(points, codec):
    frame = Frame(points, 1.0, np.zeros(3), colors=np.empty(0, np.uint8))
    sent = to_message(frame, 1, codec, 0.0005)
    assert (sent.WhichOneof("payload"), sent.point_cloud.point_count) == ("point_cloud", 0)


@pytest.mark.parametrize("codec", CODECS)
def test_without_a_display_time_or_a_deadline_none_is_asked_for(codec):
    sent = to_message(Frame(np.zeros((3, 3)), 1.0), 1, codec, 0.0005)
    assert (sent.display_time, sent.deadline, sent.point_cloud.point_count) == (0.0, 0.0, 3)


SCALES = [1000, 1.001, 0, -0.001, float("nan"), float("inf"), "0.001", None]  # none of them metres per unit


@pytest.mark.parametrize(
    ("frame", "error", "field"),
    [
        (Frame(timestamp=1.0), CodecError, "points"),
        (Frame(np.zeros((1, 3))), InvalidFrame, "timestamp"),
        (Frame(np.zeros((1, 3)), 1.0, depth=DEPTH, intrinsics=LENS), InvalidFrame, "points"),
        (Frame(None, 1.0, np.zeros(3), depth=DEPTH, intrinsics=LENS), InvalidFrame, "sensor_origin"),
        (Frame(timestamp=1.0, depth=DEPTH), CodecError, "intrinsics"),
        (Frame(timestamp=1.0, depth=DEPTH[0], intrinsics=LENS), CodecError, "depth"),
        *((Frame(timestamp=1.0, depth=DEPTH, intrinsics=LENS, depth_scale=s), InvalidFrame, "depth_scale") for s in SCALES),
        (Frame(np.zeros((1, 3)), 1.0, mask=DEPTH), InvalidFrame, "mask"),
        (Frame([], 1.0, confidence=DEPTH), InvalidFrame, "confidence"),
        (Frame(np.zeros((1, 3)), 1.0, pose=POSE), InvalidFrame, "pose"),
        (Frame(np.zeros((1, 3)), 1.0, intrinsics=LENS), InvalidFrame, "intrinsics"),
        (Frame(np.zeros((1, 3)), 1.0, display_time=float("nan")), InvalidFrame, "display_time"),
        (Frame(np.zeros((1, 3)), 1.0, display_time="soon"), InvalidFrame, "display_time"),
        (Frame(np.zeros((1, 3)), 1.0, deadline=0.0), InvalidFrame, "deadline"),
        (Frame(np.zeros((1, 3)), 1.0, deadline=float("inf")), InvalidFrame, "deadline"),
    ],
)
def test_invalid_frames_are_refused_by_field(frame, error, field):
    with pytest.raises(error) as refusal:
        message(frame)
    assert refusal.value.field == field


@pytest.mark.parametrize("points", [None, "points", iter([]), {1.0}])
def test_points_that_are_no_array_are_named_by_their_type(points):
    with pytest.raises(CodecError, match=rf"^points: expected numbers of shape \(N, 3\), got {type(points).__name__}$"):
        message(Frame(points, 1.0))


def test_a_held_frame_stays_when_the_camera_writes_the_next_one():
    buffer = np.zeros((3, 3))
    kinds = Frame(buffer, 1.0), (buffer, 1.0), SimpleNamespace(points=buffer, timestamp=1.0)
    kept = [held(frame) for frame in kinds]
    buffer += 1
    assert not any(frame.points.any() for frame in kept)


class Tensor:
    """An array of another library, which gives NumPy its memory."""

    def __init__(self, array):
        self.array = array

    def __array__(self, dtype=None, copy=None):
        return self.array


@pytest.mark.parametrize("wrap", [memoryview, Tensor, lambda buffer: [row.data for row in buffer]], ids=["view", "own", "rows"])
def test_a_held_frame_has_a_copy_of_what_is_no_array_of_numpy(wrap):
    buffer, pixels = np.zeros((3, 3)), np.ones((3, 4), np.float32)
    cloud = held(Frame(wrap(buffer), 1.0, wrap(buffer), wrap(buffer)))
    image = held(Frame(timestamp=1.0, depth=wrap(pixels), intrinsics=LENS, mask=wrap(pixels)))
    buffer += 1
    pixels[:] = 0
    assert not any(np.any(array) for array in (cloud.points, cloud.sensor_origin, cloud.body_vertices))
    assert all(np.all(array) for array in (image.depth, image.mask))


def test_a_held_list_is_that_of_its_time():
    rows = [[0.0, 0, 0], [0, 0, 1]]
    kept = held((rows, 1.0))
    rows[0][0] = 7
    assert np.array_equal(kept.points, [[0, 0, 0], [0, 0, 1]])


@pytest.mark.parametrize("points", [[[0.0, 0, 0], [1.0, 0]], "here", None, {1.0}], ids=str)
def test_what_cannot_be_an_array_is_held_as_it_is(points):
    assert held(Frame(points, 1.0)).points is points


def test_a_masked_array_is_refused_because_its_mask_would_be_lost():
    masked = np.ma.masked_invalid([[0, 0, np.nan], [0, 0, 1]])
    with pytest.raises(CodecError, match=r"^points: expected .* without a mask of NumPy, got a masked array$"):
        message(held(Frame(masked, 1.0)))


@pytest.mark.parametrize("length", [0, 1, 5])
def test_a_tuple_of_another_length_is_named_by_it(length):
    with pytest.raises(InvalidFrame, match=f"got a tuple of {length}$"):
        Frame.of((np.zeros((1, 3)),) * length)


def test_a_frame_without_points_and_depth_is_refused():
    with pytest.raises(InvalidFrame, match="frame: expected a Frame"):
        Frame.of(SimpleNamespace(timestamp=1.0))


STEPS = [0, -0.001, float("nan"), float("inf"), "0.001", True]  # none of them metres


@pytest.mark.parametrize(
    "change",
    [
        *({"depth_codec": "jpeg"}, {"compact": 1}, {"every_nth": 0}, {"every_nth": True}, {"on_notice": None}),
        *({"step": step} for step in STEPS),
    ],
)
def test_a_plan_with_unknown_options_is_refused(change):
    with pytest.raises(InvalidArgument) as refusal:
        Plan("sessions/a", 10.0, **change)
    assert refusal.value.field == next(iter(change))


@pytest.mark.parametrize("number", [np.int64, np.uint8, np.float32, np.float64])
def test_a_plan_takes_numbers_of_numpy(number):
    whole = number if np.issubdtype(number, np.integer) else np.int32
    plan = Plan("sessions/a", number(5), step=number(1), resume=number(3), every_nth=whole(2), velocities=np.bool_(True))
    given = plan.timeout, plan.step, plan.resume, plan.every_nth, plan.velocities
    assert given == (5, 1, 3, 2, True)
    assert not any(isinstance(value, np.generic) for value in given)
    options = plan.start().start.result_options
    assert (options.every_nth, options.include_velocities) == (2, True)
    assert watch_request("sessions/a", whole(2)).every_nth == 2


def test_a_plan_asks_for_compact_results_and_every_nth():
    options = Plan("sessions/a", 10.0, compact=True, every_nth=4).start().start.result_options
    assert options.vertex_encoding == pb.ARRAY_ENCODING_QUANTISED_16
    assert options.sigma_encoding == pb.ARRAY_ENCODING_FLOAT16
    assert options.reliability_encoding == pb.ARRAY_ENCODING_QUANTISED_8
    assert options.every_nth == 4
