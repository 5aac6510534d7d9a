"""Systems that a study may have beside its own."""

from __future__ import annotations

import pytest

from ddakf.evaluation.trials import methods
from tests.evaluation.studies.small import Broken, Frozen, absent


@pytest.fixture
def systems(monkeypatch):
    for name, factory in (("broken", lambda scored: Broken()), ("frozen", lambda scored: Frozen()), ("absent", absent)):
        monkeypatch.setitem(methods.BASELINES, name, factory)
