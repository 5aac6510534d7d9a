"""Data of earlier versions: this one opens their tables and sessions, or refuses a session in a sentence that names versions."""

from __future__ import annotations

import tarfile
from pathlib import Path

import numpy as np
import pytest
from ddakf_api.errors import ServiceError
from ddakf_client import connect

from ddakf.commands import cli

from ..service.conftest import TIMEOUT, running
from .make import FRAMES, LABELS, SERVER_ID, SESSION_ID, frame

pytestmark = pytest.mark.slow

ARCHIVES = sorted(Path(__file__).parent.glob("*.tar.xz"))
# What the session of an archive meets: None, it goes on; otherwise the refusal has these words.
REFUSED = {"snapshot-6": ("WorkerLost", "could not be restored: snapshot.version: expected 11 to 14, got 6")}


@pytest.fixture(params=ARCHIVES, ids=lambda path: path.name.removesuffix(".tar.xz"))
def archive(request, tmp_path) -> tuple[str, Path]:
    """The name of an archive, and the data folder in it."""
    with tarfile.open(request.param) as content:
        content.extractall(tmp_path / "data", filter="data")
    return request.param.name.removesuffix(".tar.xz"), tmp_path / "data"


def test_data_of_an_earlier_version_is_opened(archive, tmp_path, capsys):
    name, data = archive
    arguments = ["--workers", "1", "--server-id", SERVER_ID, "--data-dir", str(data), "--departure-timeout", "300"]
    with running(arguments, tmp_path) as service, connect(service.grpc, timeout=TIMEOUT) as client:
        history = client.history(SESSION_ID)
        assert history.applied.sum() == FRAMES
        session = client.open_session(SESSION_ID, flow="lossless")
        assert session.info().labels == LABELS
        assert session.info().applied == FRAMES
        following = (frame(number) for number in range(FRAMES + 1, FRAMES + 5))
        if name in REFUSED:
            with pytest.raises(ServiceError) as refused:
                list(session.track(following))
            said = f"{type(refused.value).__name__}: {refused.value}"
            assert all(word in said for word in REFUSED[name]), said
        else:
            results = list(session.track(following))
            assert [result.state for result in results] == ["tracking"] * 4
            assert np.abs(results[-1].vertices - frame(FRAMES + 4)[0]).max() < 0.01
    assert cli.main(["keys", "list", "--data-dir", str(data)]) == 0
    assert "upgrade" in capsys.readouterr().out
