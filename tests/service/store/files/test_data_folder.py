"""Data folder: one server's own while the server runs."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest
from ddakf_service.settings import Settings
from ddakf_service.store.files.data_folder import DataFolder
from ddakf_service.store.store import Store

from ddakf.errors import InvalidConfig

from ...conftest import TIMEOUT
from ..conftest import record

pytestmark = pytest.mark.slow


def test_a_second_server_is_refused_until_the_first_lets_go(tmp_path):
    first = DataFolder(tmp_path / "data")
    with pytest.raises(InvalidConfig, match="data_dir") as caught:
        DataFolder(tmp_path / "data")
    assert str(tmp_path / "data") in str(caught.value)
    first.release()
    DataFolder(tmp_path / "data").release()


def test_a_killed_server_leaves_the_folder(tmp_path):
    program = (
        "import sys, pathlib; from ddakf_service.store.files.data_folder import DataFolder; "
        f"folder = DataFolder(pathlib.Path({str(tmp_path)!r})); print('mine', flush=True); sys.stdin.read()"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", program], **pipes) as process:
        assert process.stdout.readline() == b"mine\n"
        with pytest.raises(InvalidConfig):
            DataFolder(tmp_path)
        process.send_signal(signal.SIGKILL)
    DataFolder(tmp_path).release()


def test_the_command_says_so_in_one_sentence(tmp_path):
    folder = DataFolder(tmp_path)
    command = [sys.executable, "-m", "ddakf_service", "--data-dir", str(tmp_path), "--grpc-port", "0", "--http-port", "0"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT)
    folder.release()
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert "data_dir" in line
    assert str(tmp_path) in line


@pytest.mark.parametrize("path", ["a file", "a file/below"])
def test_a_folder_that_cannot_be_is_named(tmp_path, path):
    (tmp_path / "a file").write_text("")
    with pytest.raises(InvalidConfig, match="data_dir"):
        DataFolder(tmp_path / path)


def test_a_store_that_cannot_open_lets_go_of_the_folder(tmp_path, metrics):
    with pytest.raises(InvalidConfig, match="checkpoint_url"):
        Store(Settings(data_dir=str(tmp_path), checkpoint_url="nothing://there"), metrics)
    store = Store(Settings(data_dir=str(tmp_path)), metrics)
    assert (tmp_path / "ddakf.sqlite").exists()
    store.close()


@pytest.mark.parametrize("setting", ["database_url", "checkpoint_url"])
def test_what_lies_outside_of_the_folder_is_one_server_s_as_well(tmp_path, metrics, setting):
    """Another server would end its sessions or delete their checkpoints, under any spelling of the path."""
    place, link = tmp_path / "place", tmp_path / "link"
    place.mkdir()
    link.symlink_to(place)
    scheme, name = {"database_url": ("sqlite://", "/some.sqlite"), "checkpoint_url": ("file://", "")}[setting]
    first = Store(Settings(data_dir=str(tmp_path / "one"), **{setting: f"{scheme}/{place}{name}"}), metrics)
    other = Settings(data_dir=str(tmp_path / "other"), **{setting: f"{scheme}/{link}{name}"})
    with pytest.raises(InvalidConfig, match=f"{setting}: expected a place that no other server uses.*{place}"):
        Store(other, metrics)
    first.close()
    Store(other, metrics).close()


async def test_servers_of_different_names_share_a_folder_of_checkpoints(tmp_path, metrics):
    stores = [
        Store(Settings(data_dir=str(tmp_path / name), checkpoint_url=str(tmp_path / "all"), server_id=name), metrics)
        for name in ("one", "other")
    ]
    for store in stores:
        store.close()


def test_an_sqlite_in_memory_works_by_any_of_its_names(metrics):
    store = Store(Settings(data_dir="none", database_url="sqlite:///:memory:"), metrics)
    store.registry.save(record())
    assert store.database.flush(TIMEOUT)
    assert store.database.in_memory
    store.close()


def test_without_a_folder_nothing_is_left_behind(tmp_path, metrics, monkeypatch):
    monkeypatch.chdir(tmp_path)
    store = Store(Settings(data_dir="none"), metrics)
    assert store.checkpoints is None
    store.close()
    assert list(tmp_path.iterdir()) == []
