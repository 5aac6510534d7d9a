"""Recordings by name, at their own frame rate and at others."""

import numpy as np
import pytest

from ddakf import data
from ddakf.errors import InvalidArgument
from ddakf.evaluation.splits import is_untouched
from ddakf.evaluation.trials.recordings import at_rate, find_recording


def test_at_twice_the_rate_every_second_frame_is_a_recorded_one():
    recorded, found = data.sample(), find_recording("sample@60")
    assert (found.fps, len(found), found.name) == (60.0, 2 * len(recorded) - 1, "sample")
    np.testing.assert_allclose(found.garment_vertices[::2], recorded.garment_vertices, atol=1e-6)
    np.testing.assert_allclose(found.body_vertices[::2], recorded.body_vertices, atol=1e-6)
    between = 0.5 * (recorded.garment_vertices[:-1] + recorded.garment_vertices[1:])
    np.testing.assert_allclose(found.garment_vertices[1::2], between, atol=1e-6)


@pytest.mark.parametrize("fps", [7, 25, 30, 31, 240])
def test_the_garment_is_at_a_time_where_the_recording_has_it(fps):
    recorded = data.sample()
    found = at_rate(recorded, fps)
    times = np.arange(len(found)) / fps
    assert times[-1] <= recorded.timestamp(len(recorded) - 1) < times[-1] + 1 / fps
    vertex = np.interp(times, np.arange(len(recorded)) / recorded.fps, recorded.garment_vertices[:, 17, 0])
    np.testing.assert_allclose(found.garment_vertices[:, 17, 0], vertex, atol=1e-5)


@pytest.mark.parametrize("name", ["sample@0", "nothing@60"])
def test_a_rate_of_nothing_is_refused(name):
    with pytest.raises(InvalidArgument, match="sequence: expected"):
        find_recording(name)


def test_a_recording_at_another_rate_is_as_untouched_as_it_was():
    assert is_untouched("tshirt_run_loose_19@60")
    assert not is_untouched("sample@60")
