"""Preprocessing, segmentation by colour: points of a whole person whose colours are not the garment's.

Skin and other clothes beside a garment hide where it ends, and nothing tells them from it by their place where no body is given.
Two histograms of colours are learned: of points on the garment, away from its boundaries, and of points far from it. A colour
that both have in plenty leaves nothing out. Where cloth itself has the colours of other things, as a print or a cuff like skin,
nothing is left out beside it.
"""

from __future__ import annotations

from math import exp

import numpy as np

from ddakf.config import Segmentation
from ddakf.kernels import segmentation as kernels
from ddakf.kernels.colour import LOGARITHM
from ddakf.kernels.segmentation import CELLS
from ddakf.stages.grid import nearest_vertices
from ddakf.types import FrameInput, Palette, Problem

CLOTH, OTHER = 0, 1  # histograms
DOUBTFUL = 0.7  # share of a vertex's points in the colours of other things, from which on its cloth has them


def without_others(frame: FrameInput, problem: Problem) -> FrameInput:
    """The frame without the points that are something else than the garment by their colours.

    Before anything has been learned, the frame itself is learned from, the garment being where it is predicted.
    """
    palette, position = problem.last.palette, problem.prior.position
    if palette is None:
        palette = _shown(problem, position, problem.frame, None)
    if palette is None or frame.colors is None:
        return frame
    other = _others(frame.colors, palette, problem.config.segmentation)
    doubtful = (palette.alike > DOUBTFUL * palette.seen)[problem.model.inside]
    if other.any() and doubtful.any():
        nearest, away = nearest_vertices(frame.points[other], position, problem.config.segmentation.other_distance)
        other[other] = ~(doubtful[nearest] & (away < _reach(problem)))
    return frame.only(~other) if other.any() else frame


def learned(problem: Problem, position: np.ndarray, reliability: float) -> Palette | None:
    """The palette after a frame, whose vertices are at (V, 3) ``position``, metres. A doubtful frame teaches nothing."""
    known, config, frame = problem.last.palette, problem.config.segmentation, problem.frame
    if frame.colors is None or reliability < config.learned_above:
        return known
    if known is not None:
        frame = frame.only(np.arange(0, len(frame.points), max(1, len(frame.points) // max(config.points, 1))))
    shown = _shown(problem, position, frame, known)
    if known is None or shown is None:
        return known if shown is None else shown
    kept = np.float32(exp(-problem.dt / config.memory))
    return Palette(*(kept * before + now for before, now in zip(known, shown, strict=True)))


def _shown(problem: Problem, position: np.ndarray, frame: FrameInput, known: Palette | None) -> Palette | None:
    """The palette of a frame alone, its garment at (V, 3) ``position``, metres; None where there is none.

    ``known`` is the one before, by which colours are told apart; those of the frame if None.
    """
    config, inside = problem.config.segmentation, problem.model.inside
    if frame.colors is None or config.points == 0 or len(frame.points) == 0:
        return None
    n = len(position)
    nearest, away = nearest_vertices(frame.points, position, config.other_distance)
    cloth = (inside[nearest] == nearest) & (away < _reach(problem))
    counts = np.zeros((2, *CELLS), np.float32)
    kernels.add_colors(frame.colors, cloth, LOGARITHM, counts[CLOTH])
    kernels.add_colors(frame.colors, nearest < 0, LOGARITHM, counts[OTHER])
    alike = _others(frame.colors, Palette(counts, *np.zeros((2, n))) if known is None else known, config)
    seen = (np.bincount(nearest[chosen], minlength=n).astype(np.float32) for chosen in (cloth & alike, cloth))
    return Palette(counts, *seen)


def _others(colors: np.ndarray, palette: Palette, config: Segmentation) -> np.ndarray:
    """(N,) bool: (N, 3) colours that are likelier among other things; none before enough is learned."""
    other, count = np.zeros(len(colors), bool), palette.counts.sum(axis=(1, 2, 3), keepdims=True)
    if count.min() >= config.least_points:
        likelihoods = palette.counts / count + np.float32(config.floor)
        kernels.mark_others(colors, LOGARITHM, likelihoods, config.ratio, other)
    return other


def _reach(problem: Problem) -> float:
    """Metres from a vertex within which points are on its cloth."""
    return problem.config.segmentation.cloth_distance + 0.5 * problem.model.edge_length
