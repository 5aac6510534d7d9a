"""Snapshots: the next step is exact to the bit, and bytes that are none are refused by name."""

import io
import tracemalloc
import zipfile
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddakf import Config, Mesh, Tracker, snapshot
from ddakf.errors import InvalidSnapshot
from tests.lanes import every
from tests.stages.scenes import FPS, inner_body, scan, tube
from tests.tracker_runs import SAMPLE, SHIRT

GARMENT = tube(around=16, along=8)
BODY = inner_body(GARMENT)
TIGHT = inner_body(GARMENT, 0.99)  # cloth is seen inside it
EYE = np.array([0.0, 0.3, 2.0])
KEPT = [Tracker(GARMENT, body=body) for body in (None, BODY)]  # the tests' trackers share their constants


def frames(first, count, body=None, still=True):
    """Frames of a swaying garment, over a body that follows."""
    for k in range(first, first + count):
        sway = np.array([0.02 * np.sin(0.4 * k), 0.0, 0.01 * np.cos(0.3 * k)])
        points = scan(GARMENT.vertices + sway, GARMENT, 1500, 0.003, seed=k)
        if k % 5 == 4:
            points = points[:0]
        how = {"sensor_origin": EYE, "timestamp": k / FPS}
        if body is not None and k % 7 != 6:
            how["body_vertices"] = body.vertices + sway
        yield points, how


def assert_same(a, b):
    """Two results equal to the bit."""
    for name in ("vertices", "velocities", "covariance", "sigma", "vertex_reliability", "observed"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    for name in ("reliability", "paper_score", "coverage", "state"):
        assert getattr(a, name) == getattr(b, name), name


def tracked(count, body=None, config=None):
    tracker = Tracker(GARMENT, body=body, config=config)
    for points, how in frames(0, count, body):
        tracker.step(points, **how)
    return tracker


PRESETS = {
    "default": Config(),
    "paper": Config.paper(),
    "accelerated": Config.from_dict({"predict": {"type": "ConstantAcceleration"}}),
}


@pytest.mark.parametrize("preset", list(PRESETS))
@pytest.mark.parametrize("body", [None, BODY, TIGHT], ids=["cloth alone", "body", "tight"])
@pytest.mark.parametrize("after", every(4, [7, 0, 1, 5]))
def test_the_next_steps_are_exact_to_the_bit(preset, body, after):
    tracker = tracked(after, body, PRESETS[preset])
    twin = Tracker.restore(tracker.snapshot())
    for points, how in frames(after, 4 if preset == "default" else 2, body):
        assert_same(twin.step(points, **how), tracker.step(points, **how))
    assert twin.snapshot() == tracker.snapshot()
    if body is TIGHT and preset == "default" and after > 1:
        assert min(tracker._track.body.intruded) > 0


@pytest.mark.parametrize("body", every(2, [BODY, None]), ids=["body", "cloth alone"])
def test_a_tracker_of_the_same_configuration_goes_on_exactly(body):
    tracker = tracked(5, body)
    before, twin = tracker.snapshot(), tracker.configured(tracker.config)
    for points, how in frames(5, 3, body):
        assert_same(twin.step(points, **how), Tracker.restore(before).step(points, **how))
        tracker.step(points, **how)
        before = tracker.snapshot()


@pytest.mark.parametrize(
    "stages",
    [
        {"physics": {"start_strain_kept": 1.0, "start_strain": 0.5}},
        {"anchor": {"slip_slope": 5.0, "slip_sd": 0.5}},
        {"anchor": {"clearance_slope": 5.0}},
        {"discretisation": {"working_edge": 0.03, "working_finest": 1.0}, "anchor": {"slip_sd": 0.5}},
    ],
    ids=lambda stages: "+".join(stages),
)
def test_another_configuration_goes_on_as_its_snapshot_does(stages):
    tracker = Tracker(GARMENT, body=BODY)
    tracker.reset(GARMENT.vertices * [1.02, 1.0, 1.01])  # a shape at rest of its own
    for points, how in frames(0, 5, BODY):
        tracker.step(points, **how)
    tracker = tracker.configured(Config.from_dict(stages))
    twin = Tracker.restore(tracker.snapshot())
    for points, how in frames(5, 2, BODY):
        assert_same(twin.step(points, **how), tracker.step(points, **how))


def test_renamed_fields_keep_their_values():
    changed = {"anchor": {"memory": 0.7, "slip_slope": 0.3}, "associate": {"visibility_motion": 0.004}}
    tracker = Tracker(GARMENT, body=BODY, config=Config.from_dict(changed))
    numbers, arrays = snapshot.parts(tracker)
    numbers["config"]["predict"] |= {"worn_memory": 0.7, "slip_slope": 0.3}
    numbers["config"]["associate"]["sighting"] = numbers["config"]["associate"].pop("visibility_motion")
    del numbers["config"]["anchor"]
    twin = Tracker.restore(snapshot.sealed(snapshot.pack(numbers, arrays)[16:], 18))
    assert twin.config == tracker.config


def test_how_far_a_shirt_slips_is_kept_and_of_earlier_snapshots_the_guess():
    poses = SAMPLE.body_vertices.astype(float)
    tracker = Tracker(SHIRT, body=Mesh(poses[0], SAMPLE.body_faces))
    steps = [(SAMPLE.garment_vertices[k], {"timestamp": k / 30, "body_vertices": poses[k]}) for k in range(1, 8)]
    for points, how in steps[:-1]:
        tracker.step(points, **how)
    numbers, arrays = snapshot.parts(tracker)
    twin = Tracker.restore(tracker.snapshot())
    earlier = Tracker.restore(
        snapshot.sealed(snapshot.pack(numbers, {k: v for k, v in arrays.items() if k != "worn_across"})[16:], 24)
    )
    anchor = earlier._track.anchor
    assert tracker._track.anchor.across.any()
    np.testing.assert_array_equal(anchor.across, anchor.seen * anchor.slip)
    points, how = steps[-1]
    assert_same(twin.step(points, **how), tracker.step(points, **how))


@pytest.mark.parametrize("gap_time", every(2, [0.5, 0.0]))
def test_another_configuration_goes_on_from_the_same_state(gap_time):
    stages = {"associate": {"wide_gate": 0.05}, "physics": {"gap_time": 0.5 - gap_time}}
    tracker = tracked(5, BODY, Config.from_dict(stages))
    before = tracker.snapshot()
    physics = {"stretch": 2 * tracker.config.physics.stretch, "gap_time": gap_time, "thickness": 0.001}
    config = Config.from_dict({"physics": physics})
    other = tracker.configured(config)
    assert (other.config, tracker.snapshot()) == (config, before)
    assert (other._track.body.gap is None) == (gap_time == 0)
    np.testing.assert_array_equal(other._track.state.position, tracker._track.state.position)
    points, how = next(frames(5, 1, BODY))
    twin = Tracker.restore(other.snapshot())
    changed, restored, unchanged = (t.step(points, **how) for t in (other, twin, tracker))
    assert_same(changed, restored)
    assert 0 < np.abs(changed.vertices - unchanged.vertices).max() < 0.02


def test_fields_that_only_the_last_version_had_are_not_read():
    numbers, arrays = snapshot.parts(tracked(5, BODY))
    numbers["config"]["physics"] |= {"size_pull": 0.003, "size_slack_one_side": 0.002}
    earlier, current = (snapshot.sealed(snapshot.pack(numbers, arrays)[16:], v) for v in (24, snapshot.VERSION))
    assert Tracker.restore(earlier).config == Config()
    with pytest.raises(InvalidSnapshot, match="size_pull"):
        Tracker.restore(current)


@pytest.mark.parametrize("version", every(6, [11, 12, 13, 15, 16, 17, 18]))
def test_a_snapshot_of_an_earlier_version_goes_on_without_what_it_lacks(version):
    tracker = tracked(5, BODY)
    numbers, arrays = snapshot.parts(tracker)
    anchor = numbers["config"].pop("anchor")
    assert numbers["config"]["associate"].pop("lateral_gate") == 1.4
    numbers["config"]["associate"]["beside"] = 1.4
    numbers["config"]["predict"] |= {"worn_memory": anchor["memory"], "anchor_reach": anchor["reach"]}
    if version < 17:
        numbers["config"]["predict"] |= {"worn_sd": 0.05, "worn_slope": 0.12, "anchor_first_share": 0.6}
        numbers["config"]["reliability"]["sigma_share"] = 0.8
    if version < 16:
        arrays["worn_squares"] = np.column_stack([arrays["worn_squares"], np.ones_like(arrays["worn_squares"])])
        numbers["config"]["predict"] |= {"worn_tangential_sd": 0.01, "anchor_seen_samples": 2.3}
    if version < 13:
        numbers["config"]["vertex_error"] = {"type": "VertexError", "base": 1.0}
        numbers["config"]["evidence"]["free_clearance"] = 0.05
    if version < 18:
        numbers["config"]["frame_error"] = {"type": "FrameError", "base": 1.0}
    numbers["health"]["least_strain"] = 0.1
    if version < 12:
        del numbers["health"]["reliability"]
        tracker._track = tracker._track._replace(health=tracker._track.health._replace(reliability=0.0))
    twin = Tracker.restore(snapshot.sealed(snapshot.pack(numbers, arrays)[16:], version))
    assert twin._track.health == tracker._track.health
    points, how = next(frames(5, 1, BODY))
    assert_same(twin.step(points, **how), tracker.step(points, **how))


def test_a_snapshot_that_is_not_compressed_is_the_same_state():
    tracker = tracked(3, BODY)
    plain = tracker.snapshot(compressed=False)
    assert Tracker.restore(plain).snapshot() == tracker.snapshot()


def test_taking_a_snapshot_changes_nothing():
    disturbed, undisturbed = tracked(3, BODY), tracked(3, BODY)
    disturbed.snapshot()
    assert disturbed.snapshot() == disturbed.snapshot()
    for points, how in frames(3, 2, BODY):
        assert_same(disturbed.step(points, **how), undisturbed.step(points, **how))


def test_the_restored_tracker_is_independent():
    tracker = tracked(3)
    data = tracker.snapshot()
    twin = Tracker.restore(data)
    for points, how in frames(3, 3):
        twin.step(points, **how)
    assert tracker.snapshot() == data


def test_garment_body_and_configuration_come_back():
    config = Config.from_dict({"predict": {"acceleration": 7.0}, "physics": {"fabric": "silk"}})
    twin = Tracker.restore(Tracker(GARMENT, body=BODY, config=config).snapshot())
    assert twin.config == config
    np.testing.assert_array_equal(twin.garment.vertices, GARMENT.vertices)
    np.testing.assert_array_equal(twin.garment.faces, GARMENT.faces)
    np.testing.assert_array_equal(twin.body.vertices, BODY.vertices)
    assert Tracker.restore(Tracker(GARMENT).snapshot()).body is None


def test_time_goes_on_where_it_stood():
    twin = Tracker.restore(tracked(3).snapshot())
    with pytest.raises(ValueError, match=r"timestamp: expected later than the last frame's 0\.066666667"):
        twin.step(np.empty((0, 3)), timestamp=2 / FPS)


@pytest.mark.parametrize("wrap", every(3, [memoryview, bytes, bytearray]), ids=lambda kind: kind.__name__)
def test_any_kind_of_bytes_is_read(wrap):
    assert Tracker.restore(wrap(tracked(1).snapshot())).garment.n_vertices == GARMENT.n_vertices


# Damage -------------------------------------------------------------------------------------------------------------

DATA = tracked(2, BODY).snapshot()


@given(length=st.integers(0, len(DATA) - 1))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_truncated_bytes_are_refused(length):
    with pytest.raises(InvalidSnapshot):
        Tracker.restore(DATA[:length])


@given(bits=st.sets(st.integers(0, 8 * len(DATA) - 1), min_size=1, max_size=6))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_flipped_bits_are_refused(bits):
    damaged = bytearray(DATA)
    for bit in bits:
        damaged[bit // 8] ^= 1 << bit % 8
    with pytest.raises(InvalidSnapshot):
        Tracker.restore(bytes(damaged))


def test_a_flipped_bit_of_the_head_is_refused():
    for bit in range(8 * 20):
        damaged = bytearray(DATA)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(InvalidSnapshot):
            Tracker.restore(bytes(damaged))


@given(st.binary(max_size=300))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_other_bytes_are_refused(data):
    for head in (b"", DATA[:8], DATA[:12], DATA[:16]):
        with pytest.raises(InvalidSnapshot):
            Tracker.restore(head + data)


@pytest.mark.parametrize("version", [0, 2, 999])
def test_other_versions_are_refused_by_number(version):
    other = DATA[:8] + (version + int.from_bytes(DATA[8:12], "little") if version else 0).to_bytes(4, "little") + DATA[12:]
    with pytest.raises(InvalidSnapshot, match="version") as refusal:
        Tracker.restore(other)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("data", [b"", None, 3, "DDAKFSNP" * 4, [1, 2, 3]], ids=repr)
def test_what_is_no_bytes_is_refused(data):
    with pytest.raises(InvalidSnapshot):
        Tracker.restore(data)


NOT_OURS = {
    "no compressed data": b"nothing of the kind",
    "compressed nothing": zlib.compress(b""),
    "compressed text": zlib.compress(b"nothing of the kind"),
    "half of the archive": zlib.compress(zlib.decompress(DATA[16:])[:-2000]),
    "nothing": b"",
}


@pytest.mark.parametrize("what", list(NOT_OURS))
def test_a_right_checksum_over_other_content_is_refused(what):
    with pytest.raises(InvalidSnapshot):
        Tracker.restore(snapshot.sealed(NOT_OURS[what]))


def rewritten(change) -> bytes:
    """The snapshot with its numbers and arrays changed, packed anew."""
    numbers, arrays = snapshot.unpack(DATA)
    change(numbers, arrays)
    return snapshot.pack(numbers, arrays)


def drop(name):
    return lambda numbers, arrays: arrays.pop(name)


def put(name, value):
    return lambda numbers, arrays: arrays.__setitem__(name, value)


def number(name, value):
    return lambda numbers, arrays: numbers.__setitem__(name, value)


def health(name, value):
    return lambda numbers, arrays: numbers["health"].__setitem__(name, value)


def one_of(name, value):
    """One entry of an array is another number."""
    return lambda numbers, arrays: arrays[name].reshape(-1).__setitem__(arrays[name].size // 2, value)


def sensors_of_tomorrow(numbers, arrays):
    numbers["sensors"] = [numbers["time"] + 1e4, 0]
    arrays |= {"sensors_origin": np.ones((2, 3)), "sensors_shift": np.zeros((2, 3))}
    arrays |= {"sensors_information": np.eye(6), "sensors_vector": np.zeros(6)}


def a_million_sensors(numbers, arrays):
    numbers["sensors"] = [1.0, 0]
    arrays |= {f"sensors_{name}": np.zeros((10**6, 3)) for name in ("origin", "shift")}


FOREIGN = {
    "no configuration": number("config", None),
    "an unknown configuration": number("config", {"nonsense": {}}),
    "another health": number("health", {"mood": "good"}),
    "no garment": drop("garment_V"),
    "no covariance": drop("state_P_pp"),
    "faces out of range": put("garment_F", np.full((3, 3), 10**6)),
    "a garment that is not finite": put("garment_V", np.full((4, 3), np.nan)),
    "no signs": number("signs", None),
    "no rates": number("costs", []),
    "a body that turned without end": put("contact_turn", np.array(np.inf)),
    "a drift beyond all floats": number("drift", [10**400, 0.0, 0.0, 0.0]),
}
UNCHECKED = {
    "a state of another garment": put("state_position", np.zeros((5, 3))),
    "a covariance of another shape": put("state_P_pp", np.zeros((5, 2))),
    "a state that is not finite": put("state_position", np.full(GARMENT.vertices.shape, np.nan)),
    "rotations of another garment": put("rotation", np.zeros((5, 3, 3))),
    "a body's pose of another size": put("contact_vertices", np.zeros((5, 3))),
    "a body that is seen inside by less than nothing": put("contact_intruded", np.array([-1.0, 0.1])),
    "a body that is seen inside by what is no pair": put("contact_intruded", np.zeros(3)),
    "a body that moves without bounds": put("contact_velocity", np.full(GARMENT.vertices.shape, np.inf)),
    "a body beyond all bounds": put("contact_vertices", np.full(BODY.vertices.shape, 1e300)),
    "a gap that is no number of its type": put("contact_gap", np.zeros(GARMENT.n_vertices, bool)),
    "a body whose velocity is a mean of less than no time": put("contact_span", np.array(-1.0)),
    "as many sensors as need all memory": a_million_sensors,
    "an unknown state": number("health", {"state": "happy", "physics_lambda": 1.0, "poor_for": 0.0, "empty_for": 0.0}),
    "settled for fewer than no frames": health("settling", -1),
    "a search in half a frame": health("frames_unplaced", 2.5),
    "an offset that is text": health("offset", "0.0"),
    "a doubt that is a number": health("doubtful", 1),
    "a factor that softens": health("physics_lambda", 0.0),
    "a share that is no number": health("unexplained", float("nan")),
    "a time that is text": number("time", "now"),
    "a strain that is no square": number("elasticity", -1.0),
    "a place on another body": put("worn_pose", np.zeros((5, 3))),
    "a garment of another size on the body": put("worn_position", np.zeros((5, 3))),
    "a state beyond all bounds": put("state_position", np.full(GARMENT.vertices.shape, 1e12)),
    "a covariance beyond all bounds": put("state_P_uu", np.tile(1e12 * np.eye(3), (GARMENT.n_vertices, 1, 1))),
    "position and velocity that are more than wholly correlated": one_of("state_P_pu", 1e3),
    "a drift that is no covariance": lambda numbers, arrays: arrays["drift_covariance"].__setitem__((0, 1), 1e6),
    "a drift of errors beyond all bounds": number("drift", [0.0, 0.0, 0.0, 1e308]),
    "rings that are not turned but shrunk": put("rotation", np.zeros((GARMENT.n_vertices, 3, 3))),
    "a strain beyond all bounds": number("elasticity", 1e308),
    "more than the whole cloud unexplained": health("unexplained", 1.5),
    "a factor beyond all floats": health("physics_lambda", 10**400),
    "a time at which no frame can be": number("time", 1e15),
    "sensors that were seen after the last frame": sensors_of_tomorrow,
    "a count of turns that no integer holds": put("contact_turn", np.array(2.0**70)),
    "squared deviations below zero": lambda numbers, arrays: arrays["worn_squares"].fill(-1.0),
}


@pytest.mark.parametrize("what", every(4, FOREIGN))
def test_content_that_is_no_tracker_is_refused(what):
    with pytest.raises(InvalidSnapshot):
        Tracker.restore(rewritten(FOREIGN[what]))


@pytest.mark.parametrize("what", every(6, UNCHECKED))
def test_content_of_another_shape_is_refused(what):
    with pytest.raises(InvalidSnapshot):
        Tracker.restore(rewritten(UNCHECKED[what]))


@pytest.mark.parametrize("header", [b"(", b"[", b'"""', b"  1\n 2\n", b"-" * 9000 + b"1"])
def test_an_array_with_another_header_is_refused(header):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("garment_V.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    with pytest.raises(InvalidSnapshot, match="header"):
        Tracker.restore(snapshot.sealed(zlib.compress(stream.getvalue())))


def test_repacking_is_the_identity():
    assert rewritten(lambda numbers, arrays: None) == DATA


def archived(kind: int, **members: bytes) -> bytes:
    """A snapshot whose archive holds these members."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", kind) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    body = zlib.compress(stream.getvalue(), 1)
    return snapshot.sealed(body)


def declared(shape: tuple[int, ...], data: bytes) -> bytes:
    """An array's file whose header says this shape."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return stream.getvalue() + data


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (archived(zipfile.ZIP_STORED, garment_V=declared((10**9, 3), b"")), "in 0 bytes"),
        (archived(zipfile.ZIP_STORED, garment_V=declared((-1, -1), bytes(8))), "in 8 bytes"),
        (archived(zipfile.ZIP_DEFLATED, garment_V=declared((10**6, 3), bytes(24 * 10**6))), "not compressed"),
    ],
    ids=["a shape of gigabytes", "a shape below zero", "a member that grows"],
)
def test_memory_is_not_taken_for_what_a_snapshot_declares(data, said):
    tracemalloc.start()
    try:
        with pytest.raises(InvalidSnapshot, match=said):
            Tracker.restore(data)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()
