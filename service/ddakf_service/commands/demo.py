"""Command ``ddakf demo``: a service, a virtual depth camera, a client, a table and pictures."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from ddakf_client import Frame, Result, Session, connect
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table

import ddakf
from ddakf import data
from ddakf.errors import InvalidArgument
from ddakf.evaluation import metrics
from ddakf.evaluation.drawing import pictures
from ddakf.evaluation.sensors import Cloud, Sensor
from ddakf.files.sequence import Sequence

from .export import SEED, export
from .service_process import ServiceFailed, ServiceProcess

EXIT_FAILED, EXIT_INTERRUPTED, EXIT_TERMINATED = 1, 130, 143
_RATE_WINDOW = 30  # results over which the live frame rate is shown


@dataclass(frozen=True)
class Run:
    """Results of the client, the frame number of each from 0, and the stream's duration in seconds."""

    results: list[Result]
    frames: list[int]
    seconds: float


def demonstrate(args: argparse.Namespace) -> int:
    """Runs the demo and returns the exit status. Ends the service, except with ``--keep``."""
    sequence = data.sample()
    count = len(sequence) if args.frames is None else args.frames
    if not 1 <= count <= len(sequence):
        raise InvalidArgument("frames", f"a number from 1 to {len(sequence)}", str(count))
    if args.export is not None:
        return export(args, count)
    args.out.mkdir(parents=True, exist_ok=True)
    console = Console(stderr=args.json)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(EXIT_TERMINATED))
    service = ServiceProcess(log=args.out / "service.log", keep=args.keep)
    done = False
    try:
        clouds = _prepare(console, service, sequence, count, args.view)
        run = _stream(console, service.grpc, sequence, clouds)
        table = _summary(sequence, clouds, run)
        _save_pictures(console, args, sequence, clouds, run)
        _print_summary(console, table, args.json)
        done = True
    except ServiceFailed as error:
        console.print(f"ddakf demo: {error}", highlight=False, soft_wrap=True)
        return EXIT_FAILED
    except KeyboardInterrupt:
        console.print("interrupted")
        return EXIT_INTERRUPTED
    finally:
        if not (args.keep and done):
            service.stop()
    if args.keep:
        line = f"The service keeps running: gRPC {service.grpc}, REST {service.http}; kill {service.pid} stops it."
        console.print(line, highlight=False, soft_wrap=True)
    return 0


def _prepare(console: Console, service: ServiceProcess, sequence: Sequence, count: int, view: str) -> list[Cloud]:
    """Waits for the service. Meanwhile renders all frames, so that the simulated camera takes no time during tracking."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[name]}"))
    with Progress(*columns, console=console) as bar, ThreadPoolExecutor(1) as renderer:
        starting = bar.add_task("loading kernels", total=None, name="")
        rendering = bar.add_task("rendering the camera", total=count, name="")

        def show(activity: str, done: int, total: int, name: str) -> None:
            bar.update(starting, description=f"{activity} kernels", completed=done, total=total, name=name)

        def render() -> list[Cloud]:
            sensor, rng = Sensor(view), np.random.default_rng(SEED)
            clouds = []
            for frame in range(count):
                if interrupted.is_set():
                    break
                clouds.append(sensor.capture(sequence, frame, rng))
                bar.advance(rendering)
            return clouds

        interrupted = threading.Event()
        clouds = renderer.submit(render)
        try:
            service.wait_until_ready(show)
            return clouds.result()
        except BaseException:
            interrupted.set()
            raise


def _stream(console: Console, target: str, sequence: Sequence, clouds: list[Cloud]) -> Run:
    garment = ddakf.Mesh(sequence.template, sequence.garment_faces)
    body = ddakf.Mesh(sequence.body_vertices[0], sequence.body_faces) if sequence.has_body else None
    with connect(target) as client, client.create_session(garment, body=body, flow="realtime") as session:
        session.reset(sequence.garment_vertices[0])
        return _track(console, session, sequence, clouds)


def _track(console: Console, session: Session, sequence: Sequence, clouds: list[Cloud]) -> Run:
    columns = (
        *(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()),
        TextColumn("{task.fields[rate]:5.1f} frames/s   reliability {task.fields[reliability]:.2f}"),
    )
    results: list[Result] = []
    arrivals: list[float] = []
    start = time.monotonic()
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("tracking", total=len(clouds), rate=0.0, reliability=0.0)
        for result in session.track(_frames_in_real_time(sequence, clouds), covariance=True):
            results.append(result)
            arrivals.append(time.monotonic())
            recent = arrivals[-_RATE_WINDOW:]
            rate = (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 1 else 0.0
            bar.update(task, completed=result.sequence, rate=rate, reliability=result.reliability)
    return Run(results, [result.sequence - 1 for result in results], arrivals[-1] - start)


def _frames_in_real_time(sequence: Sequence, clouds: list[Cloud]) -> Iterator[Frame]:
    """Frames at the camera's capture times."""
    start = time.monotonic()
    for number, cloud in enumerate(clouds):
        timestamp = sequence.timestamp(number)
        time.sleep(max(0.0, start + timestamp - time.monotonic()))
        body = sequence.body_vertices[number] if sequence.has_body else None
        yield Frame(cloud.points, timestamp, cloud.sensor_origin, body)


def _summary(sequence: Sequence, clouds: list[Cloud], run: Run) -> dict[str, float]:
    """Values of the table by name with unit."""
    latency = 1e3 * np.array([result.latency for result in run.results])
    tracker = 1e3 * np.array([result.timings["total"] for result in run.results])
    pairs = [(result, sequence.garment_vertices[frame]) for result, frame in zip(run.results, run.frames, strict=True)]
    distances = [metrics.squared_mahalanobis(r.vertices, truth, r.covariance) for r, truth in pairs]
    faces = sequence.garment_faces
    return {
        "frames": len(clouds),
        "dropped": run.results[-1].dropped,
        "frames per second": len(run.results) / run.seconds,
        "latency client to client, p50 (ms)": float(np.percentile(latency, 50)),
        "latency client to client, p99 (ms)": float(np.percentile(latency, 99)),
        "time in the tracker, p50 (ms)": float(np.percentile(tracker, 50)),
        "RMSE against the truth (mm)": float(np.mean([metrics.rmse_mm(r.vertices, t) for r, t in pairs])),
        "normal RMSE (mm)": float(np.mean([metrics.normal_rmse_mm(r.vertices, t, faces) for r, t in pairs])),
        "truth inside the 90 % ellipsoids (%)": 100 * metrics.coverage90(np.concatenate(distances)),
        "mean reliability": float(np.mean([result.reliability for result in run.results])),
    }


def _print_summary(console: Console, summary: dict[str, float], as_json: bool) -> None:
    if as_json:
        sys.stdout.write(json.dumps(summary, indent=2) + "\n")
        return
    table = Table("figure", "value", box=None, header_style="bold")
    table.columns[1].justify = "right"
    for name, value in summary.items():
        table.add_row(name, str(value) if isinstance(value, int) else f"{value:.2f}")
    console.print(table)


def _save_pictures(console: Console, args: argparse.Namespace, sequence: Sequence, clouds: list[Cloud], run: Run) -> None:
    shots = [
        pictures.Shot(
            points=clouds[frame].points,
            vertices=result.vertices,
            sigma=result.sigma,
            caption=f"{sequence.timestamp(frame):.2f} s   reliability {result.reliability:.2f}",
            body=sequence.body_vertices[frame] if sequence.has_body else None,
        )
        for result, frame in zip(run.results, run.frames, strict=True)
    ]
    origin = clouds[0].sensor_origin
    painter = pictures.Painter(
        shots,
        sequence.garment_faces,
        sequence.body_faces,
        title="ddakf: a garment tracked from a depth camera",
        sensor_origin=origin if origin is not None and origin.ndim == 1 else None,
    )
    still, animation = args.out / "frame.png", args.out / "animation.gif"
    with console.status("painting"):
        pictures.save_still(still, painter, shots[len(shots) // 2])
        pictures.save_animation(animation, painter, shots, sequence.fps)
    console.print(f"{still}\n{animation}", highlight=False, soft_wrap=True)
