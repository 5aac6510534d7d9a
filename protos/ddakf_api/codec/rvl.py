"""RVL, a lossless codec of 16-bit depth (Wilson 2017, "Fast lossless depth image compression", ISS 2017), without a compiler.

Runs of zeros and runs of others take turns; of the others the differences follow, folded to positive numbers. Every number
is a string of nibbles of 3 bits, least significant first, whose fourth bit says that more follow; eight nibbles fill a 32-bit
word from the top. Numbers are taken apart for the whole image at once; only the runs, two or so per row, are followed one by one.
"""

from __future__ import annotations

import numpy as np

from ddakf_api.errors import CodecError

_WORD = np.dtype("<u4")
_MAX_NIBBLES = 10  # of one number: 30 bits, more than any run or difference has
_BYTES_PER_PIXEL, _NUMBERS_PER_PIXEL = 3, 2  # most that an image takes: six nibbles of a difference, or runs of one pixel
_BEGIN, _FILL = 16, 8  # bytes and numbers more that a small image takes


def compress(image: np.ndarray) -> bytes:
    """The stream of a uint16 image of any shape, read row by row."""
    pixels = np.ascontiguousarray(image, np.uint16).ravel()
    filled = pixels != 0
    # where runs begin, the first one of zeros, maybe of none
    edges = np.flatnonzero(np.diff(filled, prepend=False))
    lengths = np.diff(np.concatenate([[0], edges, [len(pixels)]]))
    if len(lengths) % 2:
        lengths = np.append(lengths, 0)  # ends with a run of zeros: no others follow
    values = pixels[filled].astype(np.int64)
    differences = np.diff(values, prepend=0)
    folded = (differences << 1) ^ (differences >> 63)
    others = lengths[1::2]
    starts = np.arange(len(others)) * 2 + np.cumsum(others) - others  # of each pair of runs among all numbers
    numbers = np.empty(len(lengths) + len(folded), np.int64)
    numbers[starts], numbers[starts + 1] = lengths[0::2], others
    is_difference = np.ones(len(numbers), bool)
    is_difference[starts] = is_difference[starts + 1] = False
    numbers[is_difference] = folded
    return _to_words(numbers)


def decompress(data: bytes, shape: tuple[int, int], field: str) -> np.ndarray:
    """The uint16 image of this shape.

    Args:
        data: the stream, which may be anything.
        shape: height and width; the product is the caller's to bound.
        field: name for errors.

    Raises:
        CodecError: runs that do not fill the image exactly, numbers that are no depth, or more data than that.
    """
    count = shape[0] * shape[1]
    most = _BYTES_PER_PIXEL * count + _BEGIN
    if len(data) % 4 or len(data) > most:
        raise CodecError(field=field, expected=f"whole 32-bit words, at most {most} bytes", got=f"{len(data)} bytes")
    numbers = _from_words(data, _NUMBERS_PER_PIXEL * count + _FILL, field)
    starts, lengths, used = _runs(numbers, count, field)
    if len(numbers) - used > _FILL:  # nibbles that fill the last word read as zeros
        raise CodecError(field=field, expected=f"runs of {count} pixels", got="more after them")
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
    """Places of the pairs of runs among the numbers, the runs' lengths in turns, and how many numbers they take together."""
    listed, total = numbers.tolist(), len(numbers)
    starts, lengths, place, left = [], [], 0, count
    while left > 0:
        if place + 1 >= total:
            raise CodecError(field=field, expected=f"runs of {count} pixels", got=f"an end after {count - left}")
        zeros, others = listed[place], listed[place + 1]
        if zeros + others == 0:
            raise CodecError(field=field, expected="runs of pixels", got="two empty ones")
        left -= zeros + others
        starts.append(place)
        lengths += (zeros, others)
        place += 2 + others
    if left < 0 or place > total:
        raise CodecError(field=field, expected=f"runs of {count} pixels", got="longer ones" if left < 0 else "an end within one")
    return np.array(starts, np.int64), np.array(lengths, np.int64), place


def _to_words(numbers: np.ndarray) -> bytes:
    digits = np.maximum(1, -(-np.frexp(numbers.astype(np.float64))[1] // 3))
    owner = np.repeat(np.arange(len(numbers)), digits)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(digits) - digits, digits)
    nibbles = (numbers[owner] >> (3 * place)) & 7
    nibbles |= (place < digits[owner] - 1) << 3
    padded = np.zeros(-(-len(nibbles) // 8) * 8, np.uint8)
    padded[: len(nibbles)] = nibbles
    return (padded[0::2] << 4 | padded[1::2]).view(">u4").astype(_WORD).tobytes()


def _from_words(data: bytes, most: int, field: str) -> np.ndarray:
    """(n,) int64 numbers, n at most ``most``; nibbles at the end that are part of none are left out."""
    packed = np.frombuffer(data, _WORD).astype(">u4").view(np.uint8)
    nibbles = np.empty(2 * len(packed), np.uint8)
    nibbles[0::2], nibbles[1::2] = packed >> 4, packed & 15
    count = int(np.count_nonzero(nibbles < 8))
    if count > most:
        raise CodecError(field=field, expected=f"at most {most} numbers", got=str(count))
    ends = np.flatnonzero(nibbles < 8)
    if count == 0:
        return np.empty(0, np.int64)
    starts = np.concatenate([[0], ends[:-1] + 1])
    digits = ends - starts + 1
    if digits.max() > _MAX_NIBBLES:
        raise CodecError(field=field, expected=f"numbers of at most {_MAX_NIBBLES} nibbles", got=str(digits.max()))
    numbers = np.zeros(len(ends), np.int64)
    for place in range(int(digits.max())):
        more = np.flatnonzero(digits > place)
        numbers[more] |= (nibbles[starts[more] + place] & 7).astype(np.int64) << (3 * place)
    return numbers
