"""Snapshots over gRPC: restore, and rejected snapshots."""

from __future__ import annotations

import json

import numpy as np
import pytest
from ddakf_api import API_VERSION
from ddakf_api.errors import InvalidSnapshot
from ddakf_api.v1 import tracking_pb2 as pb

import ddakf

from ..conftest import Api, Talk, frame_of, make_sheet, request_of, running


def test_a_snapshot_restores_into_a_new_session(api, session, sheet):
    list(api.track(session, [request_of(frame_of(sheet, 1))]))
    snapshot = api.call("SnapshotSession", pb.SnapshotSessionRequest(name=session))
    copy = api.call("RestoreSession", pb.RestoreSessionRequest(api_version=API_VERSION, data=snapshot.data))
    following = request_of(frame_of(sheet, 2, shift=(0.004, 0, 0)))
    a, b = [list(api.track(name, [following]))[-1].result for name in (session, copy.name)]
    assert a.vertices == b.vertices
    api.delete(copy.name)
    with pytest.raises(InvalidSnapshot):
        api.call("RestoreSession", pb.RestoreSessionRequest(api_version=API_VERSION, data=snapshot.data[:-9]))


def test_a_restored_session_keeps_its_fabric(api, sheet):
    name = api.create(sheet, fabric="denim").name
    data = api.call("SnapshotSession", pb.SnapshotSessionRequest(name=name)).data
    copy = api.call("RestoreSession", pb.RestoreSessionRequest(api_version=API_VERSION, data=data))
    assert copy.fabric == "denim"
    change = {"config_json": '{"associate": {"wide_gate": 0.3}}'}
    original, restored = [
        api.call("UpdateSession", pb.UpdateSessionRequest(session=pb.Session(name=one, **change))) for one in (name, copy.name)
    ]
    assert (restored.fabric, restored.config_json) == (original.fabric, original.config_json)
    for one in (name, copy.name):
        api.delete(one)


@pytest.mark.parametrize(
    ("change", "fabric"),
    [
        ({"config_json": '{"physics": {"fabric": "denim"}}'}, "denim"),
        ({"config_json": '{"associate": {"wide_gate": 0.3}}'}, "cotton"),
        ({"fabric": "silk"}, "silk"),
        ({"config_json": '{"physics": {"fabric": "denim"}}', "fabric": "silk"}, "silk"),
    ],
    ids=["configured", "kept", "named", "both"],
)
def test_a_change_means_the_same_before_and_after_a_restore(api, sheet, change, fabric):
    created = api.create(sheet, config_json='{"physics": {"fabric": "cotton"}}')
    assert created.fabric == "cotton"
    data = api.call("SnapshotSession", pb.SnapshotSessionRequest(name=created.name)).data
    copy = api.call("RestoreSession", pb.RestoreSessionRequest(api_version=API_VERSION, data=data))
    for name in (created.name, copy.name):
        changed = api.call("UpdateSession", pb.UpdateSessionRequest(session=pb.Session(name=name, **change)))
        in_force = ddakf.Config.from_dict(json.loads(changed.config_json)).physics.fabric
        assert (changed.fabric, in_force) == (fabric, ddakf.Fabric.named(fabric))
        api.delete(name)


def test_a_fabric_that_is_named_as_changed_and_empty_is_the_default(api, sheet):
    name = api.create(sheet, fabric="cotton").name
    request = pb.UpdateSessionRequest(session=pb.Session(name=name))
    request.update_mask.paths.append("fabric")
    changed = api.call("UpdateSession", request)
    assert changed.fabric == ""
    assert ddakf.Config.from_dict(json.loads(changed.config_json)) == ddakf.Config()
    api.delete(name)


def test_a_restored_session_tells_the_time_that_frames_have_to_follow(api, session, sheet):
    list(api.track(session, [request_of(frame_of(sheet, 30))]))
    data = api.call("SnapshotSession", pb.SnapshotSessionRequest(name=session)).data
    name = api.call("RestoreSession", pb.RestoreSessionRequest(api_version=API_VERSION, data=data)).name
    with Talk(api, name) as talk:
        assert (talk.started.last_sequence_number, talk.started.last_capture_time) == (0, 1.0)
        assert "last frame's 1.0" in talk.ask(frame_of(sheet, 29))[-1].frame_error.error.message
        assert talk.ask(frame_of(sheet, 31))[-1].result.sequence_number == 31
        talk.end()
    assert api.get(name).statistics.last_capture_time == frame_of(sheet, 31).capture_time
    api.delete(name)


@pytest.fixture(scope="module")
def small_service(tmp_path_factory):
    """A service whose limits the sheet just meets as garment and as body."""
    limits = ["--max-vertices", "144", "--max-faces", "242", "--max-body-vertices", "144", "--workers", "1"]
    with running(limits, tmp_path_factory.mktemp("small")) as service:
        yield Api(service.grpc)


def torus(side: int) -> ddakf.Mesh:
    """A mesh with more faces than a sheet of as many vertices."""
    i, j = (index.ravel() for index in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    u, v = 2 * np.pi * i / side, 2 * np.pi * j / side
    vertices = np.stack([(1 + 0.3 * np.cos(v)) * np.cos(u), (1 + 0.3 * np.cos(v)) * np.sin(u), 0.3 * np.sin(v)], axis=1)
    right, up = (i + 1) % side, (j + 1) % side
    a, b, c, d = i * side + j, right * side + j, i * side + up, right * side + up
    return ddakf.Mesh(vertices, np.concatenate([np.stack([a, b, c], axis=1), np.stack([c, b, d], axis=1)]))


@pytest.mark.parametrize(
    ("garment", "body", "words"),
    [
        (13, 12, "at most 144 garment vertices, got 169"),
        (12, 13, "at most 144 body vertices, got 169"),
        (12, "torus", "at most 242 body faces, got 288"),
        (12, 12, ""),
    ],
)
def test_a_snapshot_has_the_limits_of_a_new_session(small_service, garment, body, words):
    below = torus(12) if body == "torus" else ddakf.Mesh(*make_sheet(body))
    data = ddakf.Tracker(ddakf.Mesh(*make_sheet(garment)), body=below).snapshot()
    request = pb.RestoreSessionRequest(api_version=API_VERSION, data=data)
    if not words:
        small_service.delete(small_service.call("RestoreSession", request).name)
        return
    with pytest.raises(InvalidSnapshot, match=words) as caught:
        small_service.call("RestoreSession", request)
    assert caught.value.field == "data"
