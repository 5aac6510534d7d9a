"""Garments cut for a body: shirts, trousers, skirts and more, with open hems, at rest on the resting body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ddakf.data.body import Body
from ddakf.errors import InvalidArgument
from ddakf.evaluation.simulation.cutting.outline import GAP, outside
from ddakf.evaluation.simulation.cutting.patterns import GARMENTS, Dimensions
from ddakf.evaluation.simulation.cutting.remesh import remeshed
from ddakf.mesh import Mesh

__all__ = ["FITS", "GAP", "GARMENTS", "HELD", "Dimensions", "Garment", "make", "measures"]

FEWEST_VERTICES, MOST_VERTICES = 200, 10_000  # allowed range
HELD = ("skirt", "trousers", "shorts", "straight-skirt", "cape")  # by the uppermost hem; shoulders hold the others
UPPERMOST = 0.03  # m: within it of its highest vertex lies a waistband or collar
FITS = {"close": (0.4, 0.5, 0.0), "regular": (1.0, 1.0, 0.0), "loose": (1.5, 1.5, 0.022)}
# fit: factors on looseness and flare, metres of further ease


@dataclass(frozen=True, eq=False)
class Garment:
    """A garment on the resting body.

    Attributes:
        name: of :data:`GARMENTS`.
        mesh: the rest shape, in place on the body.
        pinned: (V,) bool, the waistband or collar that moves with the body; nowhere set where the shoulders hold the garment.
    """

    name: str
    mesh: Mesh
    pinned: np.ndarray


def make(name: str, body: Body, n_vertices: int, seed: int = 0, fit: str = "regular") -> Garment:
    """Cuts a garment.

    Args:
        name: of :data:`GARMENTS`.
        body: that wears it.
        n_vertices: wanted; within a few per cent.
        seed: varies its measures by up to a tenth; 0 leaves them as they are.
        fit: of :data:`FITS`.

    Raises:
        InvalidArgument: no such garment or fit, or a number of vertices out of range.
    """
    size = measures(name, seed, fit)
    if not FEWEST_VERTICES <= n_vertices <= MOST_VERTICES:
        raise InvalidArgument("vertices", f"a number in [{FEWEST_VERTICES}, {MOST_VERTICES}]", str(n_vertices))
    mesh = remeshed(GARMENTS[name][0](body, size), n_vertices)
    mesh = Mesh(outside(mesh.vertices, body), mesh.faces)
    return Garment(name, mesh, _uppermost_hem(mesh) if name in HELD else np.zeros(mesh.n_vertices, bool))


def measures(name: str, seed: int = 0, fit: str = "regular") -> Dimensions:
    """A garment's measures in a fit: its own for seed 0, otherwise each varied by up to a tenth.

    Raises:
        InvalidArgument: no such garment or fit.
    """
    for field, value, known in (("garment", name, GARMENTS), ("fit", fit, FITS)):
        if value not in known:
            raise InvalidArgument(field, f"one of {', '.join(known)}", value)
    size = GARMENTS[name][1]
    looser, wider, ease = FITS[fit]
    size = size._replace(looseness=min(looser * size.looseness, 1.0), flare=wider * size.flare, ease=size.ease * wider + ease)
    return Dimensions(*(np.random.default_rng(seed).uniform(0.9, 1.1, len(size)) * size)) if seed else size


def _uppermost_hem(mesh: Mesh) -> np.ndarray:
    """(V,) bool: the hem's vertices that are about as high as the highest one."""
    height = np.where(mesh.boundary_vertices, mesh.vertices[:, 1], -np.inf)
    return height > height.max() - UPPERMOST
