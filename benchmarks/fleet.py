"""Plan of a fleet, and simulation of its placement and failures, from what a session was measured to cost."""

from __future__ import annotations

import heapq
import itertools
import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from ddakf_service.sessions.recovery.durability import _MAX_RESTORES as RESTORES_AT_A_TIME
from ddakf_service.store.tables.heartbeat import _BEATS as BEATS_PER_LEASE
from ddakf_service.workers.fair_shares import PLANNED_SHARE

BUSY = 0.7  # share of a core that a gateway's event loop may be busy, so that answers do not queue
LEASE = 5.0  # seconds
RESERVE, NODE_CORES = 1.1, 64  # of the simulated fleet: workers as a multiple of those that are needed; workers of a node
TOLERANCE = 0.2  # of a measured time, between it and the simulated one
ROWS = 2  # of the database, per session and second with frames: history, registry


@dataclass(frozen=True)
class Figures:
    """What a session of 2,500 vertices and 10,000 points costs. Seconds and bytes.

    Attributes:
        frame_cpu, network_cpu: processor time of a frame, in its worker and in the network process.
        frame_bytes, result_bytes: on the wire.
        checkpoint_bytes: of one checkpoint.
        worker_bytes, network_bytes: memory of a session beside that of the process.
        restore_first, restore_next: until the first session of a killed worker is back, and until each further one.
    """

    frame_cpu: float
    network_cpu: float
    frame_bytes: float
    result_bytes: float
    checkpoint_bytes: float
    worker_bytes: float
    network_bytes: float
    restore_first: float
    restore_next: float


def plan(f: Figures, sessions: int, rate: float) -> dict[str, float]:
    """What so many sessions of ``rate`` frames per second need."""
    frames = sessions * rate
    gateways = math.ceil(frames * f.network_cpu / BUSY)
    return {
        "sessions": sessions,
        "frames_per_second": frames,
        "sessions_per_core": PLANNED_SHARE / (rate * f.frame_cpu),
        "sessions_per_gigabyte": 2**30 / f.worker_bytes,
        "worker_cores": math.ceil(frames * f.frame_cpu / PLANNED_SHARE),
        "worker_gigabytes": math.ceil(sessions * f.worker_bytes / 2**30),
        "gateways": gateways,
        "gateway_gigabytes": math.ceil(sessions * f.network_bytes / 2**30),
        "gigabits_per_second_in": round(8e-9 * frames * f.frame_bytes, 1),
        "gigabits_per_second_out": round(8e-9 * frames * f.result_bytes, 1),
        "checkpoint_megabytes_per_second": round(1e-6 * frames / 30 * f.checkpoint_bytes),
        "checkpoints_per_second": round(frames / 30),
        "database_rows_per_second": ROWS * sessions,
        "heartbeats_per_second": round(gateways * BEATS_PER_LEASE / LEASE),
    }


def placed(sessions: int, gateways: int, workers: int, rng: np.random.Generator) -> list[Counter[int]]:
    """Sessions of each worker, by gateway: clients choose a gateway at random, and it the worker with the fewest sessions."""
    fleet = []
    for count in rng.multinomial(sessions, [1 / gateways] * gateways):
        load = [(0, worker) for worker in range(workers)]
        for _ in range(count):
            n, worker = load[0]
            heapq.heapreplace(load, (n + 1, worker))
        fleet.append(Counter({worker: n for n, worker in load}))
    return fleet


def back_after(groups: list[int], f: Figures) -> list[float]:
    """Seconds until each session is back; each group is restored by one worker, one after the other, eight begun at a time."""
    times = []
    for count in groups:
        lanes = [f.restore_first - f.restore_next] * min(RESTORES_AT_A_TIME, max(count, 1))
        worker = f.restore_first - f.restore_next  # a worker builds one model at a time
        for _ in range(count):
            begun = heapq.heappop(lanes)
            worker = max(worker, begun) + f.restore_next
            heapq.heappush(lanes, worker)
            times.append(worker)
    return times


def disagreements(report: dict) -> list[dict]:
    """The rows of killed workers whose simulated time is not the measured one."""
    f = Figures(**report["figures"])
    return [row for row in report["restores"] if abs(max(back_after([row["sessions"]], f)) / row["longest_s"] - 1) > TOLERANCE]


def simulated(f: Figures, sessions: int, rate: float, *, reserve: float, node_cores: int, seed: int) -> dict[str, float]:
    """The placement of so many sessions on the planned fleet, and the loss of a node and of a gateway.

    Args:
        reserve: workers, as a multiple of those that are needed.
        node_cores: workers of a node.
    """
    needs, rng = plan(f, sessions, rate), np.random.default_rng(seed)
    gateways = needs["gateways"] + 1
    workers = math.ceil(needs["worker_cores"] * reserve / gateways)  # of each gateway
    fleet = placed(sessions, gateways, workers, rng)
    # A node has the workers of several gateways, spread by Ray; each gateway's spares take their places.
    cores = list(itertools.product(range(gateways), range(workers)))
    rng.shuffle(cores)
    on_node = [fleet[gateway][worker] for gateway, worker in cores[:node_cores]]
    node_back = back_after(on_node, f)
    # The sessions of a lost gateway come to the others when its leases have expired, and join the workers there.
    on_gateway = sum(fleet[0].values())
    arrivals = rng.multinomial(on_gateway, [1 / (gateways - 1)] * (gateways - 1))
    groups = [math.ceil(n / workers) for n in arrivals for _ in range(workers)]
    return {
        "workers": gateways * workers,
        "sessions_of_fullest_worker": max(max(load.values()) for load in fleet),
        "sessions_of_lost_node": sum(on_node),
        "median_seconds_after_node": float(np.median(node_back)),
        "longest_seconds_after_node": max(node_back),
        "spares_of_gateway_for_node": math.ceil(node_cores / gateways),
        "sessions_of_lost_gateway": on_gateway,
        "longest_seconds_after_gateway": LEASE + max(back_after(groups, f)),
        "sessions_per_worker_after_gateway": max(
            (sum(load.values()) + n) / workers for load, n in zip(fleet[1:], arrivals, strict=True)
        ),
    }
