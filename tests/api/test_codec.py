"""Point-cloud codecs: exact to half a step, and safe against any input."""

import contextlib
import functools
import os
import signal
import struct
import time
import zlib
from concurrent.futures import ThreadPoolExecutor

import DracoPy
import numpy as np
import pytest
import zstandard
from ddakf_api import codec as codecs
from ddakf_api.codec import CODECS, DracoDecoder, encode, morton, planes
from ddakf_api.errors import CodecError, FrameTooCostly, Unimplemented
from ddakf_api.v1 import tracking_pb2 as pb
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from .memory import at_most

MORTON = ["morton-zstd", "morton-deflate"]
SORTED = [*MORTON, "draco"]
LOSSY = ["quantised", *SORTED]
LIMIT = 10_000
DRACO = DracoDecoder(LIMIT)  # its process starts with the first cloud
decode = functools.partial(codecs.decode, draco_decoder=DRACO)


def clouds(reach: float):
    """Up to 60 points, each coordinate within `reach` of a centre that may be anywhere."""
    inside = arrays(np.float64, st.tuples(st.integers(0, 60), st.just(3)), elements=st.floats(-reach, reach))
    centre = arrays(np.float64, 3, elements=st.floats(-1e6, 1e6))
    return st.builds(np.add, inside, centre)


def sent(points, codec, **options):
    """A cloud after the wire: decoded points, in the order of the given ones."""
    encoded = encode(points, codec, **options)
    decoded = decode(pb.PointCloud.FromString(encoded.cloud.SerializeToString()), max_points=LIMIT)
    if encoded.order is None:
        return decoded
    restored = np.empty_like(decoded)
    restored[encoded.order] = decoded
    return restored


@pytest.mark.parametrize("codec", LOSSY)
@settings(deadline=None)
@given(points=clouds(reach=10.0), step=st.sampled_from([0.0005, 0.001, 0.02]))
def test_round_trip_is_within_half_a_step(codec, points, step):
    decoded = sent(points, codec, step=step)
    assert decoded.shape == points.shape
    rounding = (1e-7 if codec == "draco" else 1e-15) * np.abs(points).max(initial=0) + 1e-12
    assert np.abs(decoded - points).max(initial=0) <= step / 2 + 4 * rounding


@given(points=clouds(reach=10.0))
def test_raw_is_float32_to_the_bit(points):
    assert np.array_equal(sent(points, "raw"), points.astype(np.float32))


@pytest.mark.parametrize("codec", CODECS)
def test_empty_cloud_is_a_cloud(codec):
    encoded = encode(np.empty((0, 3)), codec)
    assert encoded.cloud.data == b""
    assert decode(encoded.cloud, max_points=LIMIT).shape == (0, 3)


@pytest.mark.parametrize("codec", CODECS)
def test_every_layout_and_type_of_points_is_accepted_and_not_modified(codec, cloud):
    for points in (cloud.astype(np.float32), np.asfortranarray(cloud), np.repeat(cloud, 2, axis=0)[::2]):
        before = points.copy()
        assert np.abs(sent(points, codec) - cloud).max() < 0.00026
        assert np.array_equal(points, before)


@pytest.mark.parametrize("codec", SORTED)
@settings(deadline=None)
@given(lengths=st.lists(st.integers(0, 50), max_size=5), seed=st.integers(0, 9))
def test_runs_of_points_are_preserved(codec, lengths, seed):
    points = np.random.default_rng(seed).normal(size=(sum(lengths), 3))
    order = encode(points, codec, runs=lengths).order
    for start, length in zip(np.cumsum([0, *lengths]), lengths, strict=False):
        run = slice(start, start + length)
        assert sorted(order[run]) == list(range(start, start + length))
    assert np.abs(sent(points, codec, runs=lengths) - points).max(initial=0) <= 0.00026


def test_wide_codes_are_sorted_alike_on_the_slower_path(cloud):
    wide = cloud * 300  # codes of 63 bits leave no room for the index
    for points in (wide, cloud):
        order = encode(points, runs=[1000, 1000]).order
        assert np.abs(sent(points, "morton-zstd", runs=[1000, 1000]) - points).max() <= 0.00026
        assert set(order[:1000]) == set(range(1000))


@given(coordinates=arrays(np.int64, st.tuples(st.just(3), st.integers(0, 30)), elements=st.integers(0, 2**21 - 1)))
def test_morton_codes_interleave_bits(coordinates):
    codes = morton.interleave(coordinates)
    for code, point in zip(codes.tolist(), coordinates.T.tolist(), strict=True):
        assert code == sum((c >> b & 1) << (3 * b + axis) for axis, c in enumerate(point) for b in range(21))
    assert np.array_equal(morton.separate(codes), coordinates)


@given(codes=arrays(np.uint64, st.integers(1, 60), elements=st.integers(0, 2**63 - 1)))
def test_planes_hold_codes_in_any_order(codes):
    assert np.array_equal(planes.from_planes(planes.to_planes(codes), len(codes)), codes)


@pytest.mark.parametrize("codec", SORTED)
def test_default_codec_is_small(codec, cloud):
    assert len(encode(cloud, codec).cloud.data) < len(encode(cloud, "quantised").cloud.data) / 1.5


@pytest.mark.parametrize(
    ("points", "codec", "options", "field", "said"),
    [
        ([[0, 0, np.nan], [1, 1, 1]], "morton-zstd", {}, "points", "1 of 2"),
        ([[0, 0, np.inf], [1, 1, 1]], "quantised", {}, "points", "1 of 2"),
        ([[0, 0, -np.inf]], "raw", {}, "points", "1 of 1"),
        ([[0, 0, 1e39]], "raw", {}, "points", "float32"),
        ([[0, 0, 0], [40, 0, 0]], "quantised", {}, "points", "at most 32.77 m"),
        ([[0, 0, 0], [2000, 0, 0]], "morton-zstd", {}, "points", "got 2000 m"),
        ([[-1e308, 0, 0], [1e308, 0, 0]], "morton-zstd", {}, "points", "at most"),
        ([[0, 0]], "raw", {}, "points", "(N, 3)"),
        ([0, 0, 0], "raw", {}, "points", "(N, 3)"),
        ([["a", "b", "c"]], "raw", {}, "points", "(N, 3)"),
        ([[0, 0, 0]], "morton", {}, "codec", "'morton'"),
        ([[0, 0, 0]], "morton-zstd", {"step": 0}, "step", "above 0"),
        ([[0, 0, 0]], "quantised", {"step": float("nan")}, "step", "nan"),
        ([[0, 0, 0]], "morton-zstd", {"runs": [2]}, "runs", "1 points"),
        ([[0, 0, 0]], "morton-zstd", {"runs": [2, -1]}, "runs", "1 points"),
    ],
)
def test_invalid_points_and_options_are_refused(points, codec, options, field, said):
    with pytest.raises(CodecError) as refusal:
        encode(np.array(points), codec, **options)
    assert field in refusal.value.field
    assert said in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("codec", CODECS)
@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_damaged_data_gives_points_or_a_codec_error(codec, data, damaged_source):
    payload = bytearray(damaged_source[codec].data)
    for _ in range(data.draw(st.integers(0, 3))):
        payload[data.draw(st.integers(0, len(payload) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    cut = data.draw(st.integers(0, len(payload)))
    message = pb.PointCloud()
    message.CopyFrom(damaged_source[codec])
    message.data = bytes(payload[:cut]) + data.draw(st.binary(max_size=4))
    message.ClearField("crc32")  # it would detect nearly all damage
    message.point_count = data.draw(st.sampled_from([0, 1, 199, 200, 201, LIMIT, LIMIT + 1, 2**32 - 1]))
    try:
        points = decode(message, max_points=LIMIT)
    except CodecError:
        return
    assert points.shape == (message.point_count, 3)
    assert np.isfinite(points).all()


@pytest.mark.parametrize("codec", CODECS)
@settings(max_examples=200, deadline=None)
@given(payload=st.binary(max_size=300), count=st.integers(0, 40), step=st.floats(), x=st.floats())
def test_arbitrary_messages_give_points_or_a_codec_error(codec, payload, count, step, x):
    cloud = pb.PointCloud(codec=CODECS[codec], data=payload, point_count=count, step=step, origin=pb.Vector3(x=x))
    try:
        points = decode(cloud, max_points=LIMIT)
    except CodecError:
        return
    assert np.isfinite(points).all()


@pytest.mark.parametrize("codec", MORTON)
def test_flipped_bits_of_compressed_data_are_detected(codec, damaged_source):
    for position in range(0, 8 * len(damaged_source[codec].data), 7):
        message = pb.PointCloud()
        message.CopyFrom(damaged_source[codec])
        message.ClearField("crc32")
        payload = bytearray(message.data)
        payload[position // 8] ^= 1 << position % 8
        message.data = bytes(payload)
        try:
            points = decode(message, max_points=LIMIT)
        except CodecError:
            continue
        # A few header bits of a zstd frame carry no information about its content.
        assert np.array_equal(points, decode(damaged_source[codec], max_points=LIMIT))


@pytest.mark.parametrize("codec", CODECS)
@settings(max_examples=200, deadline=None)
@given(bits=st.sets(st.integers(0, 2**20), min_size=1, max_size=5))
def test_flipped_bits_are_refused_with_both_checksums(codec, bits, damaged_source):
    message = pb.PointCloud()
    message.CopyFrom(damaged_source[codec])
    payload = bytearray(message.data)
    for bit in {bit % (8 * len(payload)) for bit in bits}:
        payload[bit // 8] ^= 1 << bit % 8
    message.data = bytes(payload)
    said = f"expected CRC-32 {message.crc32:08x}, got {zlib.crc32(payload):08x}"
    with pytest.raises(CodecError, match=rf"^payload point_cloud.data of {len(payload)} bytes: {said}$") as refusal:
        decode(message, max_points=LIMIT)
    assert refusal.value.field == "point_cloud.data"


@pytest.mark.parametrize("codec", CODECS)
@given(kept=st.floats(0, 1, exclude_max=True))
def test_truncated_data_is_refused(codec, kept, damaged_source):
    message = pb.PointCloud()
    message.CopyFrom(damaged_source[codec])
    message.data = message.data[: int(kept * len(message.data))]
    with pytest.raises(CodecError, match=r"CRC-32|bytes for point_count points"):
        decode(message, max_points=LIMIT)


@pytest.mark.parametrize("codec", CODECS)
def test_the_checksum_is_always_sent_and_optional(codec, cloud):
    for points in (cloud[:0], cloud[:200]):
        message = encode(points, codec).cloud
        assert message.HasField("crc32")
        assert message.crc32 == zlib.crc32(message.data)
        expected = decode(message, max_points=LIMIT)
        message.ClearField("crc32")
        assert np.array_equal(decode(message, max_points=LIMIT), expected)


BOMB_BYTES = 256 * 1024 * 1024


def _zstd_bomb(count):
    del count
    return zstandard.ZstdCompressor(level=1).compress(bytes(BOMB_BYTES))


def _deflate_bomb(count):
    del count
    return zlib.compress(bytes(BOMB_BYTES), 9)


def _zstd_without_size(count):
    return zstandard.ZstdCompressor(write_content_size=False).compress(bytes(8 * count))


def _zstd_large_window(count):
    parameters = zstandard.ZstdCompressionParameters(window_log=27, write_content_size=True, enable_ldm=True)
    compressor = zstandard.ZstdCompressor(compression_params=parameters).compressobj(size=BOMB_BYTES)
    return compressor.compress(bytes(8 * count)) + compressor.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)


@pytest.mark.parametrize(
    ("codec", "bomb", "said"),
    [
        ("morton-zstd", _zstd_bomb, f"got {BOMB_BYTES} bytes"),
        ("morton-zstd", _zstd_large_window, f"got {BOMB_BYTES} bytes"),
        ("morton-zstd", _zstd_without_size, "declares its content size"),
        ("morton-deflate", _deflate_bomb, "at most 8000 bytes when inflated"),
    ],
)
def test_bombs_are_refused_before_memory_is_allocated(codec, bomb, said):
    message = pb.PointCloud(codec=CODECS[codec], point_count=1000, data=bomb(1000))
    with at_most(1_000_000), pytest.raises(CodecError, match=said):
        decode(message, max_points=LIMIT)


def test_declared_point_count_is_compared_with_the_limit_first():
    cloud = pb.PointCloud(codec=CODECS["morton-zstd"], point_count=5_000_000, data=b"")
    with pytest.raises(CodecError, match=r"point_count: expected at most 10000 points, got 5000000"):
        decode(cloud, max_points=LIMIT)


def test_unspecified_codec_is_the_default_and_unspecified_step_too(cloud):
    message = encode(cloud).cloud
    expected = decode(message, max_points=LIMIT)
    message.codec, message.step = 0, 0
    assert np.array_equal(decode(message, max_points=LIMIT), expected)


def test_unknown_codec_and_draco_are_told_apart():
    with pytest.raises(CodecError, match="unknown codec 77"):
        decode(pb.PointCloud(codec=77, point_count=1), max_points=LIMIT)
    with pytest.raises(Unimplemented):
        codecs.decode(pb.PointCloud(codec=pb.POINT_CODEC_DRACO, point_count=1), max_points=LIMIT)


def draco_header(data: bytes, **changes) -> bytes:
    """The data with other fields of the header."""
    names = ("magic", "major", "minor", "kind", "method", "flags", "count")
    fields = dict(zip(names, struct.unpack_from("<5sBBBBHi", data), strict=True)) | changes
    return struct.pack("<5sBBBBHi", *fields.values()) + data[15:]


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda data: data[:10], "10 bytes"),
        (lambda data: draco_header(data, magic=b"DRACA"), 'begins with "DRACO"'),
        (lambda data: draco_header(data, major=1), "1.3"),
        (lambda data: draco_header(data, kind=1), "geometry type 1"),
        (lambda data: draco_header(data, flags=0x8000), "flags 0x8000"),
        (lambda data: draco_header(data, count=2**31 - 1), f"{2**31 - 1} declared"),
        (lambda data: draco_header(data, count=-1), "-1 declared"),
        (lambda data: data[:15] + b"\x02" + data[16:], "attributes"),
    ],
)
def test_what_a_draco_header_declares_is_checked_before_it_is_decoded(spoil, said, damaged_source):
    data, unused = spoil(damaged_source["draco"].data), DracoDecoder(LIMIT)
    message = pb.PointCloud(codec=pb.POINT_CODEC_DRACO, point_count=200, data=data)
    with pytest.raises(CodecError, match=said):
        codecs.decode(message, max_points=LIMIT, draco_decoder=unused)
    assert unused.process_ids() == []


@pytest.mark.parametrize("level", [1, 7, 10])
def test_draco_of_other_writers_is_read_with_or_without_a_tree(level, cloud):
    data = DracoPy.encode(cloud.astype(np.float32), quantization_bits=14, compression_level=level)
    points = decode(pb.PointCloud(codec=pb.POINT_CODEC_DRACO, point_count=2000, data=data), max_points=LIMIT)
    order, expected = np.lexsort(points.round(3).T), np.lexsort(cloud.round(3).T)
    assert np.abs(points[order].mean(axis=0) - cloud[expected].mean(axis=0)).max() < 1e-4
    assert np.abs(np.sort(points, axis=0) - np.sort(cloud, axis=0)).max() < 1e-3


def test_a_draco_decoder_that_dies_costs_one_cloud(damaged_source):
    decoder, message = DracoDecoder(LIMIT), damaged_source["draco"]
    ask = functools.partial(codecs.decode, message, max_points=LIMIT, draco_decoder=decoder)
    expected, (first,) = ask(), decoder.process_ids()
    os.kill(first, signal.SIGKILL)
    with contextlib.suppress(CodecError):  # either the damaged cloud or the death is detected first
        ask()
    assert np.array_equal(ask(), expected)
    assert decoder.process_ids() != [first]
    decoder.close()
    assert decoder.process_ids() == []


def test_no_draco_cloud_waits_for_another(damaged_source):
    """A decoder process that stands still holds up the thread that uses it alone."""
    decoder, message = DracoDecoder(LIMIT), damaged_source["draco"]
    ask = functools.partial(codecs.decode, message, max_points=LIMIT, draco_decoder=decoder)
    expected, (stopped,) = ask(), decoder.process_ids()
    os.kill(stopped, signal.SIGSTOP)
    with ThreadPoolExecutor(1) as thread:
        waits = thread.submit(ask)
        while decoder.process_ids():  # until the thread has taken it
            time.sleep(0.001)
        assert np.array_equal(ask(), expected)
        assert not waits.done()
        os.kill(stopped, signal.SIGCONT)
        assert np.array_equal(waits.result(), expected)
    assert len(decoder.process_ids()) == 2
    decoder.close()


def test_answers_belong_to_their_draco_clouds_after_thousands_of_damaged_ones(cloud):
    """The decoder prints messages about some of them to its standard output."""
    rng, decoder = np.random.default_rng(7), DracoDecoder(200)
    sources = [encode(cloud[:200], "draco").cloud.data]
    sources += [DracoPy.encode(cloud[:200].astype(np.float32), quantization_bits=11, compression_level=n) for n in (7, 1)]
    expected = decoder.decode(sources[0], 200)
    for number in range(3000):
        data = bytearray(sources[number % 3])
        for place in rng.integers(21, len(data), rng.integers(1, 6)):
            data[place] = rng.integers(256)
        with contextlib.suppress(CodecError):
            decoder.decode(bytes(data), 200)
    assert np.array_equal(decoder.decode(sources[0], 200), expected)
    decoder.close()


def test_a_draco_cloud_that_takes_too_long_ends_its_decoder_alone():
    """A tenth of a second of work; the clock of CPU time ticks every few milliseconds."""
    points = np.random.default_rng(0).normal(size=(300_000, 3)).astype(np.float32)
    data = DracoPy.encode(points, quantization_bits=16, compression_level=1)
    decoder = DracoDecoder(300_000, seconds=0.005)
    with pytest.raises(FrameTooCostly, match=r"0\.005 s"):
        decoder.decode(data, 300_000)
    assert decoder.processor_seconds() == 0.005
    patient = DracoDecoder(300_000)
    assert patient.decode(data, 300_000).shape == points.shape
    assert patient.processor_seconds() > 0.005
    for each in (decoder, patient):
        each.close()


def test_a_draco_decoder_has_little_memory(monkeypatch):
    monkeypatch.setattr(codecs.draco, "MEMORY", 1 << 20)
    monkeypatch.setattr(codecs.draco, "MEMORY_PER_POINT", 0)
    points = np.random.default_rng(0).normal(size=(500_000, 3))
    message, decoder = encode(points, "draco").cloud, DracoDecoder(LIMIT)
    with pytest.raises(CodecError, match=r"data that cannot be decoded|decoder"):
        codecs.decode(message, max_points=500_000, draco_decoder=decoder)
    decoder.close()


@pytest.fixture(scope="session")
def cloud():
    """2,000 points of a tube half a metre wide, with 1 mm of noise."""
    rng = np.random.default_rng(3)
    angle, height = rng.uniform(0, 2 * np.pi, 2000), rng.uniform(0, 0.7, 2000)
    return np.stack([0.25 * np.cos(angle), height, 0.25 * np.sin(angle)], 1) + rng.normal(0, 0.001, (2000, 3))


@pytest.fixture(scope="session")
def damaged_source(cloud):
    return {codec: encode(cloud[:200], codec).cloud for codec in CODECS}


def test_a_signalling_nan_is_refused_as_any_other():
    cloud = encode(np.zeros((3, 3)), "raw").cloud
    cloud.data = b"\x01\x00\x80\x7f" * 9
    cloud.ClearField("crc32")
    with pytest.raises(CodecError, match="finite positions"):
        decode(cloud, max_points=10)
