"""Strain that true cloth has in common: ``python benchmarks/strains.py [--every N]``.

For every fourth frame of the training recordings, whose templates are right: the strain of the whole garment, as
``ddakf.physics.size`` measures it. Printed are quantiles of its mean over the directions, in per cent, and of its largest
principal value, and the recordings in which that is largest. What right templates show is no other size.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

import ddakf
from ddakf.evaluation.datasets import collection
from ddakf.garment import model
from ddakf.physics import size

SHARES = (0.0, 0.005, 0.05, 0.5, 0.95, 0.99, 0.995, 1.0)


def strains(name: str, every: int) -> np.ndarray:
    """(T, 2): mean strain and largest principal strain of frames of a recording."""
    sequence = collection.load(name)
    garment = model.build(ddakf.Mesh(sequence.template, sequence.garment_faces), ddakf.Config())
    seen, found = np.ones(len(sequence.template), bool), []
    for vertices in sequence.garment_vertices[::every]:
        strain, _ = size.common_strain(vertices.astype(np.float64), seen, garment, garment.rest_length, stride=1)
        found.append((np.trace(strain) / 3.0, np.abs(np.linalg.eigvalsh(strain)).max()))
    return np.array(found)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--every", type=int, default=4, help="stride of the frames")
    arguments = parser.parse_args(argv)
    found = {each.name: strains(each.name, arguments.every) for each in collection.listed(collection.TRAINING)}
    rows = np.concatenate(list(found.values()))
    print(f"{len(rows)} frames of {len(found)} recordings; strain in per cent\n{'share of the frames below':28s}", end="")
    print("".join(f"{100 * share:8.1f}" for share in SHARES))
    for title, values in (("mean over the directions", rows[:, 0]), ("largest principal strain", rows[:, 1])):
        print(f"{title:28s}" + "".join(f"{100 * value:8.2f}" for value in np.quantile(values, SHARES)))
    largest = sorted(found, key=lambda name: -found[name][:, 1].max())[:5]
    print("largest in " + ", ".join(f"{name} ({100 * found[name][:, 1].max():.1f})" for name in largest))
    return 0


if __name__ == "__main__":
    sys.exit(main())
