"""Statistics of FAUST's clips: speed and stretch of the interpolated paths, compared with straight paths of the vertices.

    python benchmarks/faust.py [PATH] [--json benchmarks/results/faust.json]

PATH: ``MPI-FAUST`` or an archive of registrations; default ``faust/registrations_s0-s7.npz`` in DDAKF_DATA. An edge's stretch is
its length over the mean, weighted by the share of the way, of its lengths in both poses; the volume likewise.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

import numpy as np
from committed import parsed

from ddakf.evaluation import machine
from ddakf.evaluation.datasets import load_faust
from ddakf.evaluation.datasets.faust import FPS, MOVING, NEUTRAL, RESTING, Faust
from ddakf.evaluation.datasets.pose_interpolation import Interpolation
from ddakf.mesh import Mesh

SHARES = (0.25, 0.5, 0.75)
RARE = 0.1  # per cent of the edges beyond the percentiles that are reported


def edge_lengths(mesh: Mesh, vertices: np.ndarray) -> np.ndarray:
    """(E,) metres."""
    return np.linalg.norm(vertices[mesh.edges[:, 1]] - vertices[mesh.edges[:, 0]], axis=1)


def volume(mesh: Mesh, vertices: np.ndarray) -> float:
    """Signed, cubic metres."""
    a, b, c = (vertices[mesh.faces[:, corner]] for corner in range(3))
    return float((np.cross(a, b) * c).sum() / 6)


def distortion(mesh: Mesh, last: np.ndarray, way) -> dict:
    """Stretch of the edges and volume of a way (share to (V, 3) vertices) from the mesh to ``last``."""
    stretches, volumes = [], []
    for share in SHARES:
        vertices, ends = way(share), (mesh.vertices, last)
        expected, inside = ((1 - share) * of(mesh, ends[0]) + share * of(mesh, ends[1]) for of in (edge_lengths, volume))
        stretches.append(edge_lengths(mesh, vertices) / expected)
        volumes.append(volume(mesh, vertices) / inside)
    stretch = np.stack(stretches)
    return {
        "mean_percent": round(100 * float(np.abs(stretch - 1).mean(axis=1).max()), 2),
        "low": round(float(np.percentile(stretch, RARE, axis=1).min()), 3),
        "high": round(float(np.percentile(stretch, 100 - RARE, axis=1).max()), 3),
        "shortest": round(float(stretch.min()), 3),
        "longest": round(float(stretch.max()), 3),
        "volume": [round(min(volumes), 3), round(max(volumes), 3)],
    }


def measured(faust: Faust, part: str) -> dict:
    """One clip."""
    clip = faust.clip(part)
    mesh, last = Mesh(clip.garment_vertices[0], clip.garment_faces), clip.garment_vertices[-1].astype(np.float64)
    way = Interpolation(mesh, last)
    step = np.linalg.norm(np.diff(clip.garment_vertices.astype(np.float64), axis=0), axis=2)
    return {
        "clip": part,
        "peak_mm_per_frame": round(1e3 * float(step.max()), 1),
        "mean_mm_per_frame": round(1e3 * float(step[:MOVING].mean()), 1),
        "largest_turn_deg": round(float(np.degrees(np.linalg.norm(way.turn, axis=1).max()))),
        "by_gradients": distortion(mesh, last, way),
        "straight": distortion(mesh, last, lambda share: (1 - share) * mesh.vertices + share * last),
    }


def summary(rows: list[dict]) -> dict:
    """Worst values over all clips, and means of the means."""
    found = {"clips": len(rows), "moving_frames": MOVING, "held_frames": RESTING, "fps": FPS}
    found["peak_mm_per_frame"] = max(row["peak_mm_per_frame"] for row in rows)
    found["median_peak_mm_per_frame"] = float(np.median([row["peak_mm_per_frame"] for row in rows]))
    found["mean_mm_per_frame"] = round(float(np.mean([row["mean_mm_per_frame"] for row in rows])), 1)
    found["largest_turn_deg"] = max(row["largest_turn_deg"] for row in rows)
    for kind in ("by_gradients", "straight"):
        found[kind] = {
            "mean_percent": round(float(np.mean([row[kind]["mean_percent"] for row in rows])), 2),
            "worst_mean_percent": max(row[kind]["mean_percent"] for row in rows),
            "low": min(row[kind]["low"] for row in rows),
            "high": max(row[kind]["high"] for row in rows),
            "shortest": min(row[kind]["shortest"] for row in rows),
            "longest": max(row[kind]["longest"] for row in rows),
            "volume": [min(row[kind]["volume"][0] for row in rows), max(row[kind]["volume"][1] for row in rows)],
        }
    return found


def main() -> int:
    default = Path(os.environ.get("DDAKF_DATA", "."), "faust", "registrations_s0-s7.npz")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("path", nargs="?", default=default, type=Path)
    parser.add_argument("--json", type=Path)
    arguments = parsed(parser, target="json")
    faust, rows = load_faust(arguments.path), []
    print(f"subjects {', '.join(map(str, faust.subjects))}; neutral pose {NEUTRAL}")
    for part in faust.clips:
        rows.append(row := measured(faust, part))
        print(part, *(f"{key} {value}" for key, value in row.items() if key != "clip"), sep="  ", flush=True)
    found = summary(rows)
    print(json.dumps(found, indent=1))
    if arguments.json:
        arguments.json.write_text(json.dumps({"commit": machine.commit(), "summary": found, "clips": rows}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
