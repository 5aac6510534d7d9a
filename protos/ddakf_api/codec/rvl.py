"""RVL: lossless compression of 16-bit depth (Wilson 2017, "Fast lossless depth image compression", ISS 2017) in NumPy.

The stream is a sequence of numbers: length of a run of zeros, length of a run of nonzero pixels, differences of these pixels
(zigzag-encoded), and so on. A number is a sequence of nibbles with 3 bits each, least significant first; the fourth bit marks
that more follow. Eight nibbles fill a 32-bit word from its most significant end. All numbers of an image are decoded at once;
only the loop over the runs, about two per row, is sequential.
"""

from __future__ import annotations

import numpy as np

from ddakf_api.errors import CodecError

_WORD = np.dtype("<u4")
_MAX_NIBBLES = 10  # of one number: 30 bits, more than any run or difference needs
_BYTES_PER_PIXEL, _NUMBERS_PER_PIXEL = 3, 2  # upper bounds: six nibbles of a difference, and runs of one pixel
_EXTRA_BYTES, _EXTRA_NUMBERS = 16, 8  # beyond these bounds, for small images and the padding of the last word


def compress(image: np.ndarray) -> bytes:
    """Encodes a uint16 image of any shape in row-major order."""
    pixels = np.ascontiguousarray(image, np.uint16).ravel()
    nonzero = pixels != 0
    # starts of the runs after the first one, which is of zeros and may be empty
    edges = np.flatnonzero(np.diff(nonzero, prepend=False))
    lengths = np.diff(np.concatenate([[0], edges, [len(pixels)]]))
    if len(lengths) % 2:
        lengths = np.append(lengths, 0)  # the last run is of zeros: an empty one follows
    values = pixels[nonzero].astype(np.int64)
    differences = np.diff(values, prepend=0)
    folded = (differences << 1) ^ (differences >> 63)
    nonzero_runs = lengths[1::2]
    starts = np.arange(len(nonzero_runs)) * 2 + np.cumsum(nonzero_runs) - nonzero_runs  # index of each pair of lengths
    numbers = np.empty(len(lengths) + len(folded), np.int64)
    numbers[starts], numbers[starts + 1] = lengths[0::2], nonzero_runs
    is_difference = np.ones(len(numbers), bool)
    is_difference[starts] = is_difference[starts + 1] = False
    numbers[is_difference] = folded
    return _to_words(numbers)


def decompress(data: bytes, shape: tuple[int, int], field: str) -> np.ndarray:
    """Decodes a uint16 image of this shape.

    Args:
        data: the stream, untrusted.
        shape: height and width; the caller bounds their product.
        field: name of the field in errors.

    Raises:
        CodecError: the runs do not fill the image exactly, a value is no 16-bit depth, or data follows.
    """
    count = shape[0] * shape[1]
    max_bytes = _BYTES_PER_PIXEL * count + _EXTRA_BYTES
    if len(data) % 4 or len(data) > max_bytes:
        raise CodecError(field=field, expected=f"whole 32-bit words, at most {max_bytes} bytes", got=f"{len(data)} bytes")
    numbers = _from_words(data, _NUMBERS_PER_PIXEL * count + _EXTRA_NUMBERS, field)
    starts, lengths, used = _runs(numbers, count, field)
    if len(numbers) - used > _EXTRA_NUMBERS:  # the padding of the last word decodes as zeros
        raise CodecError(field=field, expected=f"runs of {count} pixels", got="data after them")
    is_difference = np.ones(used, bool)
    is_difference[starts] = is_difference[starts + 1] = False
    folded = numbers[:used][is_difference]
    values = np.cumsum((folded >> 1) ^ -(folded & 1))
    if len(values) and not (values.min() >= 0 and values.max() <= 0xFFFF):
        raise CodecError(field=field, expected="depths of 16 bits", got=f"{values.min()} to {values.max()}")
    image = np.zeros(count, np.uint16)
    image[np.repeat(np.tile([False, True], len(starts)), lengths)] = values
    return image.reshape(shape)


def _runs(numbers: np.ndarray, count: int, field: str) -> tuple[np.ndarray, np.ndarray, int]:
    """Indices of the pairs of run lengths, the lengths (zeros and nonzeros in turn), and the count of numbers used."""
    listed, total = numbers.tolist(), len(numbers)
    starts, lengths, index, remaining = [], [], 0, count
    while remaining > 0:
        if index + 1 >= total:
            raise CodecError(field=field, expected=f"runs of {count} pixels", got=f"an end after {count - remaining}")
        zeros, nonzeros = listed[index], listed[index + 1]
        if zeros + nonzeros == 0:
            raise CodecError(field=field, expected="runs of pixels", got="two empty runs")
        remaining -= zeros + nonzeros
        starts.append(index)
        lengths += (zeros, nonzeros)
        index += 2 + nonzeros
    if remaining < 0 or index > total:
        got = "longer runs" if remaining < 0 else "an end inside a run"
        raise CodecError(field=field, expected=f"runs of {count} pixels", got=got)
    return np.array(starts, np.int64), np.array(lengths, np.int64), index


def _to_words(numbers: np.ndarray) -> bytes:
    digits = np.maximum(1, -(-np.frexp(numbers.astype(np.float64))[1] // 3))
    owner = np.repeat(np.arange(len(numbers)), digits)
    digit = np.arange(len(owner)) - np.repeat(np.cumsum(digits) - digits, digits)
    nibbles = (numbers[owner] >> (3 * digit)) & 7
    nibbles |= (digit < digits[owner] - 1) << 3
    padded = np.zeros(-(-len(nibbles) // 8) * 8, np.uint8)
    padded[: len(nibbles)] = nibbles
    return (padded[0::2] << 4 | padded[1::2]).view(">u4").astype(_WORD).tobytes()


def _from_words(data: bytes, max_numbers: int, field: str) -> np.ndarray:
    """(n,) int64 numbers, n at most ``max_numbers``; an incomplete number at the end is ignored."""
    packed = np.frombuffer(data, _WORD).astype(">u4").view(np.uint8)
    nibbles = np.empty(2 * len(packed), np.uint8)
    nibbles[0::2], nibbles[1::2] = packed >> 4, packed & 15
    count = int(np.count_nonzero(nibbles < 8))
    if count > max_numbers:
        raise CodecError(field=field, expected=f"at most {max_numbers} numbers", got=str(count))
    ends = np.flatnonzero(nibbles < 8)
    if count == 0:
        return np.empty(0, np.int64)
    starts = np.concatenate([[0], ends[:-1] + 1])
    digits = ends - starts + 1
    if digits.max() > _MAX_NIBBLES:
        raise CodecError(field=field, expected=f"numbers of at most {_MAX_NIBBLES} nibbles", got=str(digits.max()))
    numbers = np.zeros(len(ends), np.int64)
    for digit in range(int(digits.max())):
        longer = np.flatnonzero(digits > digit)
        numbers[longer] |= (nibbles[starts[longer] + digit] & 7).astype(np.int64) << (3 * digit)
    return numbers
