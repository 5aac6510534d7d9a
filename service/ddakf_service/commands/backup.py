"""Commands ``ddakf backup`` and ``ddakf restore``: a data folder to and from an archive, while its server runs or not."""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import shutil
import sqlite3
import sys
import tarfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import BinaryIO

from ddakf_api.errors import first_line

import ddakf
from ddakf.errors import InvalidArgument, InvalidConfig, InvalidFile

from ..setting_sources import load, shown
from ..store.files.permissions import FILE, make_folder, opener
from ..store.files.written_file import UNFINISHED
from ..store.store import NO_DATA_DIR

DATABASE, ABOUT = "ddakf.sqlite", "backup.json"
_FOLDERS = ("checkpoints", "meshes")
_NO_CONTENT = (UNFINISHED, ".lock")  # suffixes
_UNFINISHED_RESTORE = "restore" + UNFINISHED
_ATTEMPTS = 10  # to read a file of a folder in which the server writes


def back_up(args: argparse.Namespace) -> int:
    """Writes the archive and returns the exit status.

    The database comes first: a session that begins afterwards has a checkpoint and no row, and is not gone on with.
    """
    folder = _data_folder(args)
    if not (folder / DATABASE).is_file():
        raise InvalidConfig("data_dir", "the folder of a service", f"{folder}, which has no {DATABASE}")
    target = args.file.resolve()  # what a link leads to
    if not target.parent.is_dir() or (target.exists() and not target.is_file()):
        raise InvalidArgument("file", "a file in a folder that exists", str(args.file))
    unfinished = target.with_name(target.name + UNFINISHED)
    try:
        with open(unfinished, "wb", opener=opener) as file, tarfile.open(fileobj=file, mode="w") as archive:
            _add(archive, ABOUT, io.BytesIO(json.dumps({"version": ddakf.__version__, "time": time.time()}).encode()))
            with _database(folder / DATABASE, unfinished) as database:
                _add(archive, DATABASE, database)
            counted = _add_folders(archive, folder)
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(target)
    finally:
        unfinished.unlink(missing_ok=True)
    print(f"{args.file}: the database, {counted['checkpoints']} checkpoints, {counted['meshes']} meshes", file=sys.stderr)
    return 0


def restore(args: argparse.Namespace) -> int:
    """Makes a data folder from an archive and returns the exit status.

    Raises:
        InvalidFile: it is no archive of ``ddakf backup``. InvalidConfig: the folder is not empty.
    """
    folder = _data_folder(args)
    if folder.exists() and any(path.name != _UNFINISHED_RESTORE for path in folder.iterdir()):
        raise InvalidConfig("data_dir", "an empty folder, or none yet", str(folder))
    try:
        with tarfile.open(args.file) as archive:
            names = archive.getnames()
            if ABOUT not in names or DATABASE not in names:
                raise InvalidFile(str(args.file), "an archive of `ddakf backup`", "another one")
            with _unfinished(folder) as unfinished:
                for member in archive:
                    _extract(archive, member, unfinished, args.file)
                _require_whole(unfinished / DATABASE, args.file)
    except tarfile.TarError as error:
        raise InvalidFile(str(args.file), "an archive of `ddakf backup`", first_line(error)) from None
    print(f"{folder}: restored; start the service with the server_id that it had", file=sys.stderr)
    return 0


@contextlib.contextmanager
def _unfinished(folder: Path) -> Iterator[Path]:
    """A new folder in this one, whose content moves up when all has gone well, and else is removed."""
    unfinished = folder / _UNFINISHED_RESTORE  # not beside it, as that may be another file system
    shutil.rmtree(unfinished, ignore_errors=True)  # of a restore that was killed
    make_folder(unfinished)
    try:
        yield unfinished
        for path in sorted(unfinished.iterdir()):
            path.rename(folder / path.name)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _require_whole(database: Path, file: Path) -> None:
    try:
        with closing(sqlite3.connect(database)) as connection:
            (state,) = connection.execute("PRAGMA integrity_check").fetchone()
    except sqlite3.DatabaseError as error:
        state = str(error)
    if state != "ok":
        raise InvalidFile(str(file), "a whole database", state)


def _data_folder(args: argparse.Namespace) -> Path:
    """The data folder, which has everything.

    Raises:
        InvalidConfig: the service stores elsewhere.
    """
    flags = {} if args.setting_data_dir is None else {"data_dir": args.setting_data_dir}
    settings = load(flags, args.config)[0]
    if settings.data_dir == NO_DATA_DIR:
        raise InvalidConfig("data_dir", "a folder", "none: nothing is stored")
    for name, tool in (("database_url", "back up the database with its own tools"), ("checkpoint_url", "copy that place")):
        if value := getattr(settings, name):
            raise InvalidConfig(name, f"nothing, as everything is in data_dir; otherwise {tool}", shown(name, value))
    return Path(settings.data_dir).expanduser()


def _add_folders(archive: tarfile.TarFile, folder: Path) -> dict[str, int]:
    """Adds checkpoints and meshes; returns the number of files by folder."""
    counted = dict.fromkeys(_FOLDERS, 0)
    for name in _FOLDERS:
        for place in sorted({path.parent for path in (folder / name).rglob("*") if _is_content(path)}):
            for path, file in _newest(place) if name == "checkpoints" else _all(place):
                _add(archive, str(path.relative_to(folder)), file)
                counted[name] += 1
    return counted


@contextlib.contextmanager
def _database(file: Path, unfinished: Path) -> Iterator[BinaryIO]:
    """A consistent copy of a database in use: a file beside the archive, which is removed, since memory may be too small."""
    place = unfinished.with_name(f"{DATABASE}-{unfinished.name}")
    try:
        with open(place, "wb", opener=opener):
            pass
        with closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True)) as source, closing(sqlite3.connect(place)) as copy:
            copy.execute("PRAGMA journal_mode = OFF")  # a copy that fails is removed
            source.backup(copy)
        with place.open("rb") as content:
            yield content
    finally:
        place.unlink(missing_ok=True)


def _newest(session: Path) -> Iterator[tuple[Path, BinaryIO]]:
    """The newest checkpoint of a session. The server may write another one and delete this one at any time."""
    for _ in range(_ATTEMPTS):
        files = sorted(path for path in session.glob("*") if path.suffix not in _NO_CONTENT)
        if not files:
            return
        with contextlib.suppress(FileNotFoundError), files[-1].open("rb") as file:
            yield files[-1], file
            return


def _all(folder: Path) -> Iterator[tuple[Path, BinaryIO]]:
    for path in sorted(folder.iterdir()):
        if _is_content(path):
            with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
                yield path, file


def _is_content(path: Path) -> bool:
    return path.is_file() and path.suffix not in _NO_CONTENT


def _add(archive: tarfile.TarFile, name: str, file: BinaryIO) -> None:
    entry = tarfile.TarInfo(name)
    entry.size, entry.mode, entry.mtime = file.seek(0, os.SEEK_END), FILE, int(time.time())
    file.seek(0)
    archive.addfile(entry, file)


def _extract(archive: tarfile.TarFile, member: tarfile.TarInfo, folder: Path, file: Path) -> None:
    """Writes a member for the owner alone; anything but a file below the folder is refused."""
    place = Path(member.name)
    if not member.isfile() or place.is_absolute() or ".." in place.parts:
        raise InvalidFile(str(file), "files of a data folder", member.name)
    if member.name == ABOUT:
        return
    make_folder((folder / place).parent)
    with open(folder / place, "xb", opener=opener) as out:
        shutil.copyfileobj(archive.extractfile(member), out)
