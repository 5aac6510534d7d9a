"""Data of this version for the tests of later ones: ``python -m tests.upgrade.make NAME`` writes NAME.tar.xz beside this file.

A service tracks ten frames of a sheet of cloth, stores a checkpoint of each, and stops in order. The archive has its data folder.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

import numpy as np
from ddakf_client import connect

HERE = Path(__file__).parent
SERVER_ID, SESSION_ID, LABELS, FRAMES = "upgrade", "upgrade-sheet", {"take": "7"}, 10
SIDE, SPACING, SHIFT, RATE = 12, 0.02, 0.002, 30.0  # vertices, metres, metres per frame, frames per second

# `ddakf keys` without the entry points, which belong to the installed version, not to the one on the path
KEYS = """
import argparse, sys
try:
    from ddakf_service.commands.cli import register_keys
except ModuleNotFoundError:  # of earlier versions
    from ddakf_service.commands import register_keys
parser = argparse.ArgumentParser()
register_keys(parser.add_subparsers())
arguments = parser.parse_args()
sys.exit(arguments.run(arguments))
"""


def sheet() -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) metres and (F, 3) of a square of cloth."""
    x, y = np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij")
    corner = (x[:-1, :-1] * SIDE + y[:-1, :-1]).ravel()
    lower = np.stack([corner, corner + SIDE, corner + 1], axis=1)
    upper = np.stack([corner + 1, corner + SIDE, corner + SIDE + 1], axis=1)
    return SPACING * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1), np.concatenate([lower, upper])


def frame(number: int) -> tuple[np.ndarray, float]:
    """The sheet itself as a cloud, frame `number`, and its time."""
    return sheet()[0] + [SHIFT * number, 0, 0], number / RATE


def main(name: str) -> None:
    """Runs a service on an empty folder and archives what it stored."""
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder, "data")
        arguments = ["--json", "--grpc-port", "0", "--http-port", "0", "--workers", "1", "--data-dir", str(data)]
        arguments += ["--server-id", SERVER_ID, "--checkpoint-every", "1"]
        service = subprocess.Popen([sys.executable, "-m", "ddakf_service", *arguments], stdout=subprocess.PIPE)
        ready = next(event for event in map(json.loads, service.stdout) if event["event"] == "ready")
        with connect(ready["grpc"]) as client:
            session = client.create_session(*sheet(), flow="lossless", labels=LABELS, session_id=SESSION_ID)
            results = list(session.track(frame(number) for number in range(1, FRAMES + 1)))
        assert [result.state for result in results] == ["tracking"] * FRAMES
        keys = ["keys", "--data-dir", str(data), "create", "upgrade", "--scope", "read"]
        subprocess.run([sys.executable, "-c", KEYS, *keys], check=True, stdout=subprocess.DEVNULL)
        service.send_signal(signal.SIGTERM)
        assert service.wait(60) == 0
        with tarfile.open(HERE / f"{name}.tar.xz", "w:xz") as archive:
            for path in sorted(data.rglob("*")):
                if path.is_file() and path.name != "lock":
                    archive.add(path, path.relative_to(data))


if __name__ == "__main__":
    main(sys.argv[1])
