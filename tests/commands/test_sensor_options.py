"""The options of a virtual sensor: every one reaches its field, in metres and shares."""

import argparse

import pytest

from ddakf.commands import sensor_options
from ddakf.errors import InvalidArgument
from ddakf.evaluation.sensors import Sensor


def sensor(*words, **how):
    parser = argparse.ArgumentParser()
    sensor_options.add(parser)
    return sensor_options.sensor(parser.parse_args(words), **how)


def test_a_virtual_sensor_has_noise_unless_told_otherwise_and_a_real_one_its_own():
    assert sensor() == Sensor(view="front", points=10_000, noise=0.003)
    assert sensor(virtual=False) == Sensor(view="front", points=10_000, noise=0.0)
    assert sensor("--noise-mm", "0").noise == 0
    assert sensor("--noise-mm", "2", virtual=False).noise == 0.002


@pytest.mark.parametrize(
    ("words", "field", "value"),
    [
        ("--view ring4", "view", "ring4"), ("--points 500", "points", 500), ("--noise-mm 5", "noise", 0.005),
        ("--drop 0.2", "drop", 0.2), ("--outliers 0.1", "outliers", 0.1), ("--depth-noise-mm 1.4", "depth_noise", 0.0014),
        ("--depth-step-mm 2.9", "depth_step", 0.0029), ("--fliers 0.5", "fliers", 0.5), ("--occlude 38:68", "occlude", (38, 68)),
        ("--every 3", "every", 3),
    ],
)  # fmt: skip
def test_every_option_reaches_its_field_alone(words, field, value):
    expected = vars(sensor()) | {field: pytest.approx(value) if isinstance(value, float) else value}
    assert vars(sensor(*words.split())) == expected


def test_a_hidden_share_belongs_to_frames_in_which_it_is_hidden():
    assert sensor("--occlude", "38:68", "--occluded", "0.25").occluded == 0.25
    with pytest.raises(InvalidArgument, match="occluded: expected to be used with --occlude"):
        sensor("--occluded", "0.25")


def test_a_real_sensor_has_its_own_view():
    with pytest.raises(InvalidArgument, match="view: expected none for a recording"):
        sensor("--view", "full", virtual=False)


@pytest.mark.parametrize("window", ["38", "38:", ":68", "a:b", "68:38", "5:5", "-1:5", "1:2:3", "1:9999999999"])
def test_a_window_is_two_numbers_in_order(window):
    with pytest.raises(InvalidArgument, match="occlude"):
        sensor(f"--occlude={window}")


def test_one_of_several_views_is_chosen_by_the_caller():
    parser = argparse.ArgumentParser()
    sensor_options.add(parser, several_views=True)
    arguments = parser.parse_args(["--view", "full,front+body"])
    assert arguments.view == "full,front+body"
    assert sensor_options.sensor(arguments, view="ring4").view == "ring4"
