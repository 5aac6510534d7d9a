"""Streaming benchmark: overhead of a service with the Python client, several clients, and the codecs."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import inputs
import numpy as np
from ddakf_api.codec import CODECS, DEPTH_CODECS, DracoDecoder, decode, decode_depth, encode, encode_depth
from ddakf_client import Frame, Result, connect
from ddakf_service.commands.service_process import running_service
from library import WARM, percentiles

import ddakf
from ddakf import data
from ddakf.evaluation import metrics
from ddakf.evaluation.sensors import Camera, Intrinsics
from ddakf.files import depth as depths

IMAGE = (256, 192, 200.0)  # pixels, pixels, and the focal length in them: the depth sensor of a phone
VIEWPOINT = (0.0, 1.2, 2.0), (0.0, 1.1, 0.0)  # eye and target, m
WALL = 3.0  # m behind the garment


def through_a_service(settings) -> dict:
    """Overhead of the service, and several concurrent clients."""
    with running_service(["--workers", str(settings.workers)]) as service:
        return {"overhead": _overhead(settings, service.grpc), "clients": _clients(settings, service.grpc)}


def _overhead(settings, address: str) -> list[dict]:
    """Latency at the client less the tracker's own time, one frame under way at a time, by codec."""
    run = inputs.run_of(data.sample(), settings.service_frames, "front", settings.points)
    rows = []
    with connect(address, timeout=60) as client:
        for codec in settings.codecs:
            results = list(_one_at_a_time(client, run, codec))
            warm = results[min(WARM, len(results) - 1) :]
            own = [1e3 * r.timings["total"] for r in warm]
            rows.append(
                {
                    "codec": codec,
                    "vertices": run.sequence.garment_vertices.shape[1],
                    "points": round(float(np.mean([len(cloud.points) for cloud in run.clouds]))),
                    "frames": len(results),
                    "latency_ms": percentiles([1e3 * r.latency for r in warm]),
                    "tracker_ms": percentiles(own),
                    "overhead_ms": percentiles([1e3 * r.latency - ms for r, ms in zip(warm, own, strict=True)]),
                    "decode_ms": percentiles([1e3 * r.timings["decode"] for r in warm]),
                    "encode_ms": percentiles([1e3 * r.timings["encode"] for r in warm]),
                    "rmse_mm": round(
                        float(np.mean([metrics.rmse_mm(r.vertices, t) for r, t in zip(results, _truths(run), strict=True)])), 3
                    ),
                }
            )
    return rows


def _one_at_a_time(client, run: inputs.Run, codec: str) -> Iterator[Result]:
    permit = threading.Semaphore(1)

    def frames():
        for _, cloud, how in run.frames():
            permit.acquire()
            yield Frame(cloud.points, **how)

    with _session(client, run, codec=codec, flow="lossless") as session:
        for result in session.track(frames()):
            yield result
            permit.release()


def _session(client, run: inputs.Run, **options):
    session = client.create_session(ddakf.Mesh(run.sequence.template, run.sequence.garment_faces), **options)
    session.reset(run.sequence.garment_vertices[0])
    return session


def _truths(run: inputs.Run) -> np.ndarray:
    return run.sequence.garment_vertices[1:]


def _clients(settings, address: str) -> dict:
    """Several clients, each sending the sample at its 30 frames per second with the backpressure policy realtime."""
    run = inputs.run_of(data.sample(), settings.client_frames, "full", settings.points)
    with ThreadPoolExecutor(settings.clients) as pool:
        answers = list(pool.map(lambda _: _paced(address, run), range(settings.clients)))
    latency = [1e3 * r.latency for results in answers for r in results[min(WARM, len(results) - 1) :]]
    return {
        "clients": settings.clients,
        "workers": settings.workers,
        "frames_sent": settings.clients * len(run.clouds),
        "frames_answered": sum(len(results) for results in answers),
        "frames_dropped": sum(results[-1].dropped for results in answers),
        "latency_ms": percentiles(latency),
    }


def _paced(address: str, run: inputs.Run) -> list[Result]:
    def frames():
        start = time.monotonic()
        for number, cloud, how in run.frames():
            time.sleep(max(0.0, start + number / run.sequence.fps - time.monotonic()))
            yield Frame(cloud.points, **how)

    with connect(address, timeout=60) as client, _session(client, run, flow="realtime") as session:
        return list(session.track(frames()))


def codec_costs(settings) -> list[dict]:
    """Encoding and decoding one cloud by codec, in this process."""
    cloud = inputs.run_of(data.sample(), 1, "full", 2 * settings.points).clouds[0].points
    rows, draco = [], DracoDecoder(len(cloud))
    for name in CODECS:
        encoded, encoding = _timed(settings.codec_repeats, lambda name=name: encode(cloud, name))
        decoded, decoding = _timed(
            settings.codec_repeats, lambda message=encoded.cloud: decode(message, max_points=len(cloud), draco_decoder=draco)
        )
        sent = cloud if encoded.order is None else cloud[encoded.order]
        rows.append(
            {
                "codec": name,
                "points": len(cloud),
                "bytes": len(encoded.cloud.data),
                "encode_ms": encoding,
                "decode_ms": decoding,
                "largest_error_mm": round(1e3 * float(np.abs(decoded - sent).max()), 4),
            }
        )
    draco.close()
    return rows


def image_costs(settings) -> list[dict]:
    """Encoding, decoding and unprojecting one depth image with its mask by codec, in this process."""
    width, height, focal = IMAGE
    lens = depths.Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2)
    metres, mask = _image(lens, width, height)
    units = np.rint(1e3 * metres).astype(np.uint16)
    rows = []
    for name in DEPTH_CODECS:
        rows.append(_image_costs(settings, name, units, metres, mask, lens))
        if name in ("none", "zstd"):  # the others hold integers alone
            rows.append(_image_costs(settings, name, metres.astype(np.float32), metres, mask, lens))
    return rows


def _image_costs(settings, name: str, image: np.ndarray, metres: np.ndarray, mask: np.ndarray, lens: depths.Intrinsics) -> dict:
    repeats = settings.codec_repeats
    message, encoding = _timed(repeats, lambda: encode_depth(image, lens, mask=mask, codec=name))
    back, decoding = _timed(repeats, lambda: decode_depth(message, max_pixels=image.size))
    _, unprojecting = _timed(repeats, lambda: _unprojected(back, lens))
    return {
        "codec": f"{name}, {image.dtype.name}",
        "pixels": image.size,
        "bytes": len(message.data),
        "mask_bytes": len(message.mask),
        "encode_ms": encoding,
        "decode_ms": decoding,
        "unproject_ms": unprojecting,
        "largest_error_mm": round(1e3 * float(np.abs(back.depth - metres).max()), 4),
    }


def _unprojected(image, lens: depths.Intrinsics) -> np.ndarray:
    keep = depths.without_fliers(image.depth, depths.largest_step(image.depth, lens.fx)) & image.keep
    return depths.unproject(image.depth, keep, lens, image.pose)


def _image(lens: depths.Intrinsics, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) metres of the sample before a wall with 3 mm of noise and 2 % holes, and the garment's mask."""
    sequence, rng = data.sample(), np.random.default_rng(inputs.SEED)
    camera = Camera.looking_at(Intrinsics(width, height, *lens), *VIEWPOINT)
    depth, face = camera.render(
        [(sequence.garment_vertices[0], sequence.garment_faces), (sequence.body_vertices[0], sequence.body_faces)]
    )
    depth = np.where(np.isfinite(depth), depth, WALL) + rng.normal(0, 0.003, depth.shape)
    depth[rng.random(depth.shape) < 0.02] = 0.0
    return depth, (face >= 0) & (face < len(sequence.garment_faces))


def _timed(repeats: int, call) -> tuple[object, dict]:
    """The return value of a call, and percentiles of its milliseconds after a first call."""
    times, outcome = [], call()  # which imports, and starts processes
    for _ in range(repeats):
        begun = time.perf_counter()
        outcome = call()
        times.append(1e3 * (time.perf_counter() - begun))
    return outcome, percentiles(times)
