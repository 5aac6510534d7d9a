"""Depth-image codecs: exact round trips, and safe against any input."""

import struct
import zlib

import numpy as np
import pytest
import zstandard
from ddakf_api.codec import DEPTH_CODECS, decode_depth, encode_depth, rvl
from ddakf_api.errors import CodecError, InvalidFrame
from ddakf_api.v1 import tracking_pb2 as pb
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from .memory import at_most

LENS = (200.0, 201.0, 31.5, 23.5)
LIMIT = 64 * 48
SHAPES = st.tuples(st.integers(1, 12), st.integers(1, 12))
UNITS = st.one_of(st.just(0), st.integers(0, 3), st.integers(0, 2**16 - 1))


def sent(image: pb.DepthImage):
    return decode_depth(pb.DepthImage.FromString(image.SerializeToString()), max_pixels=LIMIT)


def scene(rng=None) -> np.ndarray:
    """(48, 64) uint16 millimetres: a slope before a wall, and holes."""
    rng = np.random.default_rng(0) if rng is None else rng
    depth = np.full((48, 64), 3000)
    depth[10:40, 20:50] = 1500 + 3 * np.arange(30)
    depth += rng.integers(-3, 4, depth.shape)
    depth[rng.random(depth.shape) < 0.05] = 0
    return depth.astype(np.uint16)


@pytest.mark.parametrize("codec", DEPTH_CODECS)
@given(depth=arrays(np.uint16, SHAPES, elements=UNITS), scale=st.sampled_from([0.001, 0.0001, 0.25]))
def test_units_round_trip_exactly(codec, depth, scale):
    back = sent(encode_depth(depth, LENS, depth_scale=scale, codec=codec))
    assert back.depth.dtype == np.float32
    assert np.array_equal(back.depth, depth * np.float32(scale))
    assert back.keep is None
    assert back.intrinsics == LENS
    assert np.array_equal(back.pose, np.eye(3, 4))


@pytest.mark.parametrize("codec", DEPTH_CODECS)
@given(depth=arrays(np.float32, SHAPES, elements=st.floats(width=32)))
def test_metres_round_trip_to_the_bit(codec, depth):
    assert sent(encode_depth(depth, LENS, codec=codec)).depth.tobytes() == depth.tobytes()


@pytest.mark.parametrize("codec", DEPTH_CODECS)
@given(data=st.data(), least=st.integers(0, 255))
def test_mask_and_confidence_select_pixels(codec, data, least):
    shape = data.draw(SHAPES)
    mask = data.draw(arrays(bool, shape))
    confidence = data.draw(arrays(np.uint8, shape))
    both = encode_depth(np.ones(shape), LENS, mask=mask, confidence=confidence, min_confidence=least, codec=codec)
    assert np.array_equal(sent(both).keep, mask & (confidence >= max(least, 1)))
    assert np.array_equal(sent(encode_depth(np.ones(shape), LENS, mask=mask, codec=codec)).keep, mask)


def decoded_as_published(data: bytes, count: int) -> list[int]:
    """Reference decoder after the listing of the paper."""
    words = list(struct.unpack(f"<{len(data) // 4}I", data))
    nibbles = [word >> shift & 15 for word in words for shift in range(28, -1, -4)]
    place = 0

    def number() -> int:
        nonlocal place
        value = shift = 0
        while True:
            nibble = nibbles[place]
            place += 1
            value |= (nibble & 7) << shift
            shift += 3
            if not nibble & 8:
                return value

    pixels, previous = [], 0
    while len(pixels) < count:
        pixels += [0] * number()
        for _ in range(number()):
            folded = number()
            previous += folded >> 1 ^ -(folded & 1)
            pixels.append(previous)
    return pixels


@given(depth=arrays(np.uint16, SHAPES, elements=UNITS))
def test_rvl_is_the_published_format(depth):
    assert decoded_as_published(rvl.compress(depth), depth.size) == depth.ravel().tolist()


def test_rvl_of_a_known_image_is_these_bytes():
    # 1 zero, 2 nonzeros: differences 5 and -2, zigzag 10 = 2 + 8 * 1 and 3; nibbles 1 2 A 1 3, then 1 zero and 0 nonzeros
    assert rvl.compress(np.array([[0, 5, 3, 0]], np.uint16)) == struct.pack("<I", 0x12A13100)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "an end after 0"),
        (b"\0" * 3, "whole 32-bit words"),
        (b"\0" * 4096, "at most"),
        (b"\0" * 4, "two empty runs"),
        (struct.pack("<I", 0x01000000), "two empty runs"),
        (struct.pack("<I", 0x0F700000), "longer runs"),
        (struct.pack("<I", 0x09700000), "longer runs|an end"),
        (b"\xff" * 4, "an end after 0"),
        (b"\xff" * 8, "an end after 0"),
        (struct.pack("<2I", 0xFFFFFFFF, 0xFFFFFF00), "at most 10 nibbles"),
    ],
)
def test_runs_that_do_not_fill_the_image_are_refused(data, said):
    image = pb.DepthImage(encoding=2, compression=4, width=4, height=1, data=data, intrinsics=pb.Intrinsics(fx=1, fy=1))
    with pytest.raises(CodecError, match=said) as refusal:
        decode_depth(image, max_pixels=LIMIT)
    assert refusal.value.field == "depth_image.data"


def png(width: int, height: int, pixels: bytes, *, bits: int = 16, colour: int = 0, extra: bytes = b"") -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + extra + chunk(b"IDAT", zlib.compress(pixels, 9)) + chunk(b"IEND", b"")


def of(data: bytes, compression: str, *, width: int = 64, height: int = 48, **fields) -> pb.DepthImage:
    image = pb.DepthImage(encoding=2, compression=DEPTH_CODECS[compression], width=width, height=height, data=data, **fields)
    image.intrinsics.fx = image.intrinsics.fy = 100
    return image


BOMB = 256 << 20


@pytest.mark.parametrize(
    ("image", "said"),
    [
        (of(b"", "none", width=2**16, height=2**16), "1 to 3072 pixels, got 65536 x 65536"),
        (of(b"", "none", width=0), "0 x 48"),
        (of(bytes(1 << 20), "none"), "at most 80896 bytes, got 1048576 bytes"),
        (of(b"", "none", mask=bytes(1 << 20)), "depth_image.mask"),
        (of(bytes(6143), "none"), "6144 bytes for 64 x 48 pixels, got 6143"),
        (of(zstandard.compress(bytes(BOMB), 1), "zstd"), f"got {BOMB} bytes"),
        (of(png(30_000, 30_000, b""), "png"), "64 x 48 pixels, got 30000 x 30000"),
        (of(png(64, 48, b"", bits=8), "png"), "16-bit greyscale.*8 bits"),
        (of(png(64, 48, b"", colour=2), "png"), "colour type 2"),
        (of(png(64, 48, b"short"), "png"), "damaged"),
        (of(b"\x89PNG\r\n\x1a\n", "png"), "truncated"),
        (of(b"JFIF", "png"), "without its signature"),
        (of(bytes(16 * 64 * 48), "rvl"), "at most"),
    ],
)
def test_declared_sizes_are_checked_before_memory_is_allocated(image, said):
    with pytest.raises(CodecError):
        sent(of(png(64, 48, b""), "png"))  # Pillow is imported
    with at_most(1_500_000), pytest.raises(CodecError, match=said):
        decode_depth(image, max_pixels=LIMIT)


def test_chunks_without_pixels_are_ignored():
    text = b"zTXt" + b"a\0\0" + zlib.compress(bytes(BOMB), 9)
    extra = struct.pack(">I", len(text) - 4) + text + struct.pack(">I", zlib.crc32(text))
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in np.full((480, 640), 7))
    image = of(png(640, 480, rows, extra=extra), "png", width=640, height=480)
    assert (decode_depth(image, max_pixels=640 * 480).depth == np.float32(0.007)).all()


@pytest.mark.parametrize("codec", DEPTH_CODECS)
@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_damaged_images_give_an_image_or_an_error(codec, data):
    source = encode_depth(scene(), LENS, mask=scene() < 2000, codec=codec)
    name = data.draw(st.sampled_from(["data", "data", "mask"]))
    payload = bytearray(getattr(source, name))
    for _ in range(data.draw(st.integers(0, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    setattr(source, name, bytes(payload[: data.draw(st.integers(0, len(payload)))]))
    try:
        back = sent(source)
    except CodecError:
        return
    assert back.depth.shape == (48, 64)


@settings(max_examples=300, deadline=None)
@given(
    payload=st.binary(max_size=200),
    numbers=st.tuples(*[st.integers(0, 6)] * 3),
    size=SHAPES,
    lens=st.tuples(*[st.floats()] * 4),
    pose=st.lists(st.floats(), max_size=13),
    scale=st.floats(),
)
def test_arbitrary_messages_give_an_image_or_an_error(payload, numbers, size, lens, pose, scale):
    encoding, compression, mask = numbers
    image = pb.DepthImage(
        encoding=encoding, compression=compression, height=size[0], width=size[1], data=payload, depth_scale=scale,
        mask=payload, mask_compression=mask, pose=pb.Pose(matrix=pose),
        intrinsics=pb.Intrinsics(fx=lens[0], fy=lens[1], cx=lens[2], cy=lens[3]),
    )  # fmt: skip
    try:
        back = decode_depth(image, max_pixels=100)
    except InvalidFrame:
        return
    assert back.depth.shape == size
    assert np.isfinite(back.pose).all()


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"pose": pb.Pose(matrix=[2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0])}, "depth_image.pose.matrix"),
        ({"pose": pb.Pose(matrix=[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0])}, "depth_image.pose.matrix"),
        ({"pose": pb.Pose(matrix=[1.0] * 11)}, "depth_image.pose.matrix"),
        ({"pose": pb.Pose(matrix=[float("nan")] * 12)}, "depth_image.pose.matrix"),
        ({"intrinsics": pb.Intrinsics(fx=1)}, "depth_image.intrinsics"),
        ({"intrinsics": pb.Intrinsics(fx=1, fy=1, cx=float("inf"))}, "depth_image.intrinsics"),
        ({"depth_scale": -1}, "depth_image.depth_scale"),
        ({"depth_scale": 1000.0}, "depth_image.depth_scale"),  # millimetres per metre
        ({"encoding": 9}, "depth_image.encoding"),
        ({"compression": 9}, "depth_image.data"),
        ({"confidence": bytes(64 * 48), "min_confidence": 256}, "depth_image.min_confidence"),
        ({"mask": bytes(7)}, "depth_image.mask"),
        ({"mask": bytes(8), "mask_compression": 4}, "depth_image.mask"),
        ({"colors": bytes(64 * 48)}, "depth_image.colors"),
    ],
)
def test_invalid_cameras_are_refused_by_field(change, field):
    image = encode_depth(scene(), LENS)
    image.MergeFrom(pb.DepthImage(**{name: value for name, value in change.items() if name not in ("pose", "intrinsics")}))
    for name in change.keys() & {"pose", "intrinsics"}:
        getattr(image, name).CopyFrom(change[name])
    with pytest.raises(InvalidFrame) as refusal:
        decode_depth(image, max_pixels=LIMIT)
    assert refusal.value.field == field


@pytest.mark.parametrize(
    ("depth", "options", "field"),
    [
        (np.ones((2, 2)), {"codec": "jpeg"}, "depth_codec"),
        (np.ones(4), {}, "depth"),
        (np.ones((2, 2), int), {}, "depth"),
        ("abc", {}, "depth"),
        (np.ones((2, 2)), {"mask": np.ones((2, 3))}, "mask"),
        (np.ones((2, 2)), {"confidence": np.ones((2, 2))}, "confidence"),
        (np.ones((2, 2)), {"pose": np.eye(3)}, "pose"),
        (np.ones((2, 2)), {"colors": np.ones((2, 2), np.uint8)}, "colors"),
        (np.ones((2, 2)), {"colors": np.ones((2, 2, 3))}, "colors"),
        (np.ones((2, 2)), {"confidence": np.ones((2, 2), np.uint8), "min_confidence": 300}, "min_confidence"),
    ],
)
def test_invalid_images_and_options_are_refused_by_field(depth, options, field):
    with pytest.raises(CodecError) as refusal:
        encode_depth(depth, LENS, **options)
    assert refusal.value.field == field
    assert "\n" not in str(refusal.value)


def test_a_pose_by_columns_is_not_taken_for_one_by_rows():
    """ARKit, WebXR and glTF write columns: the shift would be dropped and the turn reversed."""
    pose = np.eye(4)
    pose[:3, 3] = 0.5, 1.25, -2.0
    assert encode_depth(np.ones((2, 2)), LENS, pose=pose).pose.matrix[3::4] == [0.5, 1.25, -2.0]
    with pytest.raises(CodecError) as refusal:
        encode_depth(np.ones((2, 2)), LENS, pose=pose.T)
    assert str(refusal.value) == "pose: expected a last row of 0, 0, 0, 1, got 0.5, 1.25, -2, 1"


def test_intrinsics_are_four_numbers():
    with pytest.raises(CodecError, match="fx, fy, cx, cy"):
        encode_depth(np.ones((2, 2)), (1.0, 2.0))
    with pytest.raises(CodecError, match="intrinsics"):
        encode_depth(np.ones((2, 2)), None)


def _alternating(shape):
    """Every other pixel: the most runs that an image can have."""
    return np.where(np.indices(shape).sum(axis=0) % 2, 1, 0).astype(np.uint16)


def _leaping(shape):
    """The largest differences."""
    return np.where(np.indices(shape)[1] % 2, 65535, 1).astype(np.uint16)


SHAPE = (300, 400)


@pytest.mark.parametrize("codec", DEPTH_CODECS)
@pytest.mark.parametrize("image", [_alternating, _leaping, np.zeros])
def test_memory_stays_within_the_documented_bound(codec, image):
    depth = image(SHAPE).astype(np.uint16)
    message = encode_depth(depth, LENS, mask=depth > 0, confidence=depth.astype(np.uint8), codec=codec)
    decode_depth(message, max_pixels=depth.size)
    with at_most(200 * depth.size):
        back = decode_depth(message, max_pixels=depth.size)
    assert np.array_equal(back.depth, depth * np.float32(0.001))


@pytest.mark.parametrize("word", [0x00000000, 0x11111111, 0x08080808, 0xFFFFFFFF, 0x01010101])
def test_memory_stays_within_the_bound_for_any_runs(word):
    count = SHAPE[0] * SHAPE[1]
    data = np.full(3 * count // 4, word, "<u4").tobytes()
    image = of(data, "rvl", width=SHAPE[1], height=SHAPE[0])
    with at_most(200 * count), pytest.raises(CodecError):
        decode_depth(image, max_pixels=count)


@pytest.mark.parametrize(
    ("more", "field"),
    [
        ({"confidence": np.full((4, 6), 256, np.uint16)}, "confidence"),
        ({"confidence": np.ones((4, 6), np.uint8), "min_confidence": 0.5}, "min_confidence"),
        ({"confidence": np.ones((4, 6), np.uint8), "min_confidence": 256}, "min_confidence"),
    ],
)
def test_confidences_that_one_byte_does_not_hold_are_named(more, field):
    with pytest.raises(CodecError, match=f"^{field}: expected .* 255"):
        encode_depth(np.ones((4, 6)), LENS, **more)
    whole = encode_depth(np.ones((4, 6)), LENS, confidence=np.full((4, 6), 255, np.uint16), min_confidence=255.0)
    assert sent(whole).keep.all()


@pytest.mark.parametrize("kind", [bool, *np.typecodes["AllInteger"]])
def test_a_mask_may_be_of_any_whole_numbers(kind):
    mask = np.arange(24).reshape(4, 6) % 3 == 0
    assert np.array_equal(sent(encode_depth(np.ones((4, 6)), LENS, mask=(mask * 64).astype(kind))).keep, mask)


@pytest.mark.parametrize("kind", [np.int8, np.uint32, np.int64, bool, float])
def test_the_types_of_a_confidence_are_named(kind):
    with pytest.raises(CodecError, match=r"^confidence: expected uint8 or uint16 of shape \(4, 6\), got "):
        encode_depth(np.ones((4, 6)), LENS, confidence=np.ones((4, 6), kind))
