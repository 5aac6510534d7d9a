"""Order of frames, and the masks and colours of images, by their names."""

from pathlib import Path

import pytest

from ddakf.evaluation.datasets.captures.frame_names import beside, in_order


@pytest.mark.parametrize(
    "names",
    [
        ["9.ply", "10.ply", "11.ply"],
        ["1700000000.04.ply", "1700000000.12.ply", "1700000000.2.ply"],  # seconds, as a program prints them
        ["0.0333.ply", "0.1.ply", "0.25.ply"],
        ["1.2.ply", "1.9.ply", "1.10.ply"],
        ["cam0_2.ply", "cam0_10.ply"],
        ["a.ply", "b.ply", "c.ply"],
    ],
)
def test_frames_are_in_the_order_of_their_numbers_or_times(names):
    assert [path.name for path in in_order(Path(name) for name in reversed(names))] == names


@pytest.mark.parametrize(
    ("images", "others"),
    [
        (["1305031102.16", "1305031102.19"], ["1305031102.16", "1305031102.19"]),
        (["cam0_1", "cam0_2"], ["mask0_1", "mask0_2"]),
        (["848x480_1", "848x480_2"], ["848x480_1_mask", "848x480_2_mask"]),
        (["b", "a"], ["b", "a"]),
        (["1", "2"], ["1-of-3", "2-of-3"]),
    ],
)
def test_others_are_those_of_the_same_name_or_numbers(images, others):
    found = beside([Path(f"{name}.png") for name in images], [Path(f"{name}.jpg") for name in sorted(others)])
    assert [path.stem for path in found] == others


@pytest.mark.parametrize(
    ("images", "others"),
    [
        (["1305031102.16", "1305031102.19"], ["1305031102.17", "1305031102.2"]),  # taken at other times
        (["cam0_1", "cam0_2"], ["cam0_1"]),
        (["1", "2"], ["1a", "1b"]),
    ],
)
def test_what_is_not_clear_belongs_to_no_image(images, others):
    assert None in beside([Path(name) for name in images], [Path(name) for name in others])
