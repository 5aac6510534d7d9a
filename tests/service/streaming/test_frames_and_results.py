"""Frames and results: depth images, Draco, compact results, predictions to a display time."""

from __future__ import annotations

import itertools
import os
import signal
from dataclasses import replace

import numpy as np
import pytest
from ddakf_api import codec
from ddakf_api.arrays import pack_mesh, unpack
from ddakf_api.errors import DeadlineExceeded
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import Frame, FrameError, Limits

import ddakf
from ddakf.evaluation.sensors import Camera, Intrinsics
from ddakf.files import depth as depths

from ..conftest import Talk, children, frame_of, make_sheet, request_of, workers

SHEET = make_sheet(20)
FRAMES = 6
SPEED = np.array([0.3, 0.0, 0.1])  # m/s
CAMERA = Camera.looking_at(Intrinsics(128, 96, 150.0, 150.0, 63.5, 47.5), [0.19, 0.19, 1.2], [0.19, 0.19, 0.0])
POSE = np.column_stack([CAMERA.axes.T, CAMERA.eye])
LENS = (150.0, 150.0, 63.5, 47.5)


def moved(number: int) -> np.ndarray:
    """The sheet's vertices in a frame."""
    return SHEET.vertices + number / 30 * SPEED


def seen(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth (96, 128) of the sheet in front of a wall, and the mask of the sheet."""
    depth, _ = CAMERA.render([(moved(number), SHEET.faces)])
    mask = np.isfinite(depth)
    return np.where(mask, depth, 2.5), mask


def images(**options):
    for number in range(1, FRAMES + 1):
        depth, mask = seen(number)
        yield Frame(timestamp=number / 30, depth=depth, intrinsics=LENS, pose=POSE, mask=mask, **options)


def tracked(client, frames, **options) -> list:
    with client.create_session(SHEET, flow="lossless") as session:
        return list(session.track(frames, **options))


def test_a_frame_that_nobody_needs_any_more_is_late_and_no_other(client):
    both = [*images(deadline=30.0), *images(deadline=1e-9)]
    frames = [replace(frame, timestamp=number / 30) for number, frame in enumerate(both, 1)]
    with client.create_session(SHEET, flow="lossless") as session:
        answers = list(session.track(frames, on_error="yield"))
        info = session.info()
    late = [answer for answer in answers if isinstance(answer, FrameError)]
    assert [answer.sequence for answer in late] == [*range(FRAMES + 1, 2 * FRAMES + 1)]
    assert {type(answer.error) for answer in late} == {DeadlineExceeded}
    assert (info.applied, info.late, info.rejected) == (FRAMES, FRAMES, 0)
    assert 0 < info.last_latency < (info.last_frame_time - info.create_time).total_seconds()


@pytest.mark.parametrize(("flow", "budgets"), [(pb.FLOW_MODE_REALTIME, True), (pb.FLOW_MODE_LOSSLESS, False)])
def test_a_result_says_what_was_used_and_frames_in_realtime_flow_have_budgets(api, flow, budgets):
    name = api.create(SHEET).name
    with Talk(api, name, flow=flow) as talk:
        usages = [talk.ask(frame_of(SHEET, number))[-1].result.usage for number in range(1, 8)]
    assert all(0 < usage.processor_seconds < 10 for usage in usages)
    assert usages[0].budget_seconds == 0.0, "no rate is known of the first frame"
    assert all((usage.budget_seconds > 0) == budgets for usage in usages[2:])
    assert all(usage.widening >= 1.0 for usage in usages)
    api.delete(name)


@pytest.mark.parametrize("depth_codec", ["zstd", "none"])
def test_a_depth_image_tracks_as_its_points_do(client, depth_codec):
    tracker = ddakf.Tracker(ddakf.Mesh(*SHEET))
    for number, result in enumerate(tracked(client, images(), depth_codec=depth_codec), 1):
        depth, mask = (array.astype(np.float32) if array.dtype == float else array for array in seen(number))
        keep = mask & depths.without_fliers(depth, depths.largest_step(depth, 150.0))
        points = depths.unproject(depth, keep, depths.Intrinsics(*LENS), POSE)
        expected = tracker.step(points, timestamp=number / 30, sensor_origin=CAMERA.eye)
        assert np.array_equal(result.vertices, expected.vertices.astype(np.float32))
        assert result.coverage == expected.coverage > 0.5


def test_the_colors_of_pixels_and_of_points_reach_the_tracker(client):
    tracker, sheet = ddakf.Tracker(ddakf.Mesh(*SHEET)), []
    pattern = np.random.default_rng(0).integers(40, 216, (96, 128, 3), np.uint8)
    coloured = list(images(colors=pattern))
    for frame, result in zip(coloured, tracked(client, coloured), strict=True):
        depth = frame.depth.astype(np.float32)
        keep = frame.mask & depths.without_fliers(depth, depths.largest_step(depth, 150.0))
        points = depths.unproject(depth, keep, depths.Intrinsics(*LENS), POSE)
        expected = tracker.step(points, timestamp=frame.timestamp, sensor_origin=CAMERA.eye, colors=pattern[keep])
        assert np.array_equal(result.vertices, expected.vertices.astype(np.float32))
        sheet.append(Frame(points, frame.timestamp, CAMERA.eye, colors=pattern[keep]))
    assert tracker._track.appearance is not None
    assert np.array_equal(tracked(client, sheet, codec="raw")[-1].vertices, expected.vertices.astype(np.float32))


def test_colors_of_another_length_cost_their_frame_alone(api, session, sheet):
    first, second = frame_of(sheet, 1), frame_of(sheet, 2)
    first.point_cloud.colors = bytes(7)
    refused, result = list(api.track(session, [request_of(first), request_of(second)]))[1:]
    assert refused.frame_error.error.field == "point_cloud.colors"
    assert result.result.sequence_number == 2


@pytest.mark.parametrize("depth_codec", ["zstd", "png", "rvl"])
def test_millimetres_in_any_compression_track_alike(client, depth_codec):
    frames = [Frame(**{**vars(frame), "depth": np.rint(1000 * frame.depth).astype(np.uint16)}) for frame in images()]
    last = tracked(client, frames, depth_codec=depth_codec)[-1]
    error = np.linalg.norm(last.vertices - moved(FRAMES), axis=1)
    assert np.median(error) < 0.005
    assert last.coverage > 0.5


def test_pixels_of_low_confidence_are_no_measurement(client):
    none = np.full((96, 128), 99, np.uint8)
    unsure, sure = (tracked(client, images(confidence=none, min_confidence=least))[-1] for least in (100, 99))
    assert unsure.coverage == 0
    assert sure.coverage > 0.5


def test_a_session_s_own_bound_holds_for_what_a_depth_image_measures(client):
    """Masked pixels and flying pixels are not points."""
    depth, mask = (array.astype(np.float32) if array.dtype == float else array for array in seen(1))
    count = int(np.count_nonzero(mask & depths.without_fliers(depth, depths.largest_step(depth, 150.0))))
    with client.create_session(SHEET, flow="lossless", limits=Limits(max_points=count - 1)) as session:
        first, second = itertools.islice(images(), 2)
        (refused,) = session.track([first], on_error="yield")
        assert isinstance(refused, FrameError)
        assert f"at most {count - 1} pixels" in str(refused.error)
        assert str(count) in str(refused.error)
        session.update(limits=Limits(max_points=count))
        (result,) = session.track([first])
        assert result.coverage > 0.5
        cloud = Frame(SHEET.vertices[:1].repeat(count + 1, 0), second.timestamp)
        (refused,) = session.track([cloud], on_error="yield")
        assert isinstance(refused, FrameError)


def test_a_depth_image_without_points_is_a_frame_without_measurements(client):
    frames = [Frame(timestamp=number / 30, depth=np.zeros((4, 4)), intrinsics=LENS) for number in (1, 2)]
    results = tracked(client, frames)
    assert [result.coverage for result in results] == [0, 0]


def test_every_codec_of_points_is_tracked(api, session, sheet):
    requests = [request_of(frame_of(sheet, i, codec_name=name)) for i, name in enumerate(codec.CODECS, 1)]
    results = [response.result for response in api.track(session, requests)][1:]
    assert [result.frames_applied for result in results] == list(range(1, len(codec.CODECS) + 1))
    assert min(result.coverage for result in results) > 0.9


def test_a_draco_decoder_that_is_killed_costs_one_frame_at_most(service, api, session, sheet):
    first = [request_of(frame_of(sheet, i, codec_name="draco")) for i in (1, 2)]
    assert [r.result.sequence_number for r in api.track(session, first)][1:] == [1, 2]
    decoders = [child for worker in workers(service.pid) for child in children(worker)]
    assert decoders
    for decoder in decoders:
        os.kill(decoder, signal.SIGKILL)
    later = [request_of(frame_of(sheet, i, codec_name="draco")) for i in (3, 4)]
    answers = list(api.track(session, later))[1:]
    assert answers[-1].result.sequence_number == 4
    assert answers[0].WhichOneof("message") == "result" or answers[0].frame_error.error.name == "CodecError"


def test_compact_results_are_as_exact_as_they_say(client):
    plain, compact = (tracked(client, images(), compact=compact) for compact in (False, True))
    step = 1.5 * np.ptp(SHEET.vertices, axis=0).max() / 65535
    for exact, result in zip(plain, compact, strict=True):
        assert np.abs(result.vertices - exact.vertices).max() <= 0.5 * step + 1e-7
        assert np.abs(result.sigma / exact.sigma - 1).max() <= 2**-11 * 1.01
        assert np.abs(result.vertex_reliability - exact.vertex_reliability).max() <= 0.5 / 255 + 1e-6


def test_a_compact_result_takes_nine_bytes_per_vertex_and_holds_still(api, session, sheet):
    options = pb.ResultOptions(
        vertex_encoding=pb.ARRAY_ENCODING_QUANTISED_16,
        sigma_encoding=pb.ARRAY_ENCODING_FLOAT16,
        reliability_encoding=pb.ARRAY_ENCODING_QUANTISED_8,
    )
    requests = [request_of(frame_of(sheet, number)) for number in (1, 2)]
    results = [r.result for r in api.track(session, requests, result_options=options) if r.HasField("result")]
    arrays = [(r.vertices, r.sigma, r.vertex_reliability) for r in results]
    assert [sum(len(array.data) for array in row) for row in arrays] == [9 * len(sheet.vertices)] * 2
    assert results[0].vertices.step == results[1].vertices.step
    lattice = [np.asarray(r.vertices.offset) / r.vertices.step for r in results]
    assert np.allclose(lattice, np.rint(lattice), atol=1e-6)


def test_covariance_and_velocities_are_the_trackers(client):
    tracker = ddakf.Tracker(ddakf.Mesh(*SHEET))
    frames = [Frame(moved(number).astype(np.float32), number / 30) for number in range(1, FRAMES + 1)]
    results = tracked(client, frames, codec="raw", velocities=True, covariance=True, every_nth=2)
    for frame, result in zip(frames, results, strict=True):
        expected = tracker.step(frame.points, timestamp=frame.timestamp)
        assert result.reliability == expected.reliability
        if result.applied % 2:
            assert len(result.vertices) == 0
            assert result.covariance is result.velocities is None
            continue
        assert np.array_equal(result.velocities, expected.velocities.astype(np.float32))
        assert np.array_equal(result.covariance, expected.covariance.astype(np.float32))
        assert result.display_time == result.timestamp


def test_an_answer_at_display_time_is_nearer_to_what_is_shown_and_changes_nothing(client):
    delay, later, speed = 0.08, [], np.array([0.0, 0.0, 0.4])  # across the cloth, where points tell of it
    frames = [Frame(SHEET.vertices + number / 30 * speed, number / 30) for number in range(1, 16)]
    plain = tracked(client, frames)
    for frame in frames:
        later.append(Frame(frame.points, frame.timestamp, display_time=frame.timestamp + delay))
    ahead = tracked(client, [*later[:-1], frames[-1]], velocities=True)
    assert np.array_equal(ahead[-1].vertices, plain[-1].vertices)
    shown = SHEET.vertices + (14 / 30 + delay) * speed
    assert ahead[-2].display_time == later[-2].display_time
    assert np.linalg.norm(ahead[-2].vertices - shown) < 0.6 * np.linalg.norm(plain[-2].vertices - shown)
    assert (ahead[-2].sigma > plain[-2].sigma).all()
    assert ahead[-2].reliability == plain[-2].reliability


async def test_depth_images_and_display_times_from_the_asynchronous_client(service):
    from ddakf_client import aconnect

    async with aconnect(service.grpc) as client, client.create_session(SHEET, flow="lossless") as session:
        frames = [Frame(**{**vars(frame), "display_time": frame.timestamp + 0.03}) for frame in images()]
        results = [result async for result in session.track(frames, depth_codec="zstd", compact=True)]
    assert [result.display_time for result in results] == [frame.display_time for frame in frames]
    assert results[-1].coverage > 0.5


def test_a_body_carries_the_prediction(api):
    below = SHEET.vertices - np.array([0, 0, 0.05])
    name = api.create(SHEET, body=pack_mesh(below, SHEET.faces)).name

    def frame(number: int, display_time: float = 0.0) -> pb.TrackRequest:
        message = pb.Frame(sequence_number=number, capture_time=number / 30, display_time=display_time)
        message.body_vertices = (below + number / 30 * SPEED).astype("<f4").tobytes()
        message.point_cloud.CopyFrom(codec.encode(moved(number)).cloud)
        return request_of(message)

    requests = [frame(number) for number in range(1, 10)] + [frame(10, 10 / 30 + 0.1)]
    result = list(api.track(name, requests))[-1].result
    vertices = unpack(result.vertices, 3, field="vertices", max_items=1000)
    shown = moved(10) + 0.1 * SPEED
    assert np.abs((vertices - shown).mean(axis=0)).max() < 0.005
    api.delete(name)
