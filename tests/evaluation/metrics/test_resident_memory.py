"""Resident memory of known allocations."""

import numpy as np
import pytest

from ddakf.evaluation import metrics

MIB = 2**20


def test_the_peak_is_seen_after_the_memory_is_given_back():
    peak = metrics.ResidentPeak()
    if peak.mib() is None:
        pytest.skip("the system keeps no peak that can be started anew")
    before = peak.mib()
    taken = np.ones(64 * MIB, np.uint8)
    del taken
    assert 60 <= peak.mib() - before <= 80
    assert metrics.ResidentPeak().mib() < 30, "a new one starts anew"
