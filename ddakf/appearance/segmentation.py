"""Preprocessing, segmentation by colour: points of a whole person whose colours are not the garment's.

Skin and other clothes beside a garment hide where it ends, and nothing tells them from it by their place where no body is given.
Two histograms of colours are learned: of points on the garment, away from its boundaries, and of points far from it. A colour
that both have in plenty leaves nothing out beside the garment. Nor is anything left out beside cloth that was seen in colours of
other things, such as a print or a cuff like skin.
"""

from __future__ import annotations

from math import exp

import numpy as np

from ddakf.config import Segmentation
from ddakf.kernels import segmentation as kernels
from ddakf.kernels.colour import LOGARITHM
from ddakf.kernels.segmentation import CELLS
from ddakf.stages.grid import nearest_vertices, spread_rows
from ddakf.types import FrameInput, Palette, Problem

CLOTH, OTHER = 0, 1  # histograms
DOUBTFUL = 0.7  # share of a vertex's points in the colours of other things, from which on its cloth has them
KNOWN = 0.5  # share of the points far from the garment in the colours of other things; with fewer, light or camera have changed
FIRST = 10  # as many times more points are learned from where nothing is known


def without_others(frame: FrameInput, problem: Problem) -> FrameInput:
    """The frame without the points that are something else than the garment by their colours.

    Before anything has been learned, the frame itself is learned from, the garment being where it is predicted.
    """
    config, position = problem.config.segmentation, problem.prior.position
    palette = _palette(frame, problem, position)
    if palette is None:
        return frame
    other = _others(frame.colors, palette, config)
    doubtful = (palette.alike > DOUBTFUL * palette.seen)[problem.model.inside]
    if other.any() and doubtful.any():
        nearest, away = nearest_vertices(frame.points[other], position, config.other_distance)
        other[other] = ~(doubtful[nearest] & (away < _reach(problem)))
    return frame.only(~other) if other.any() else frame


def of_garment_colors(frame: FrameInput, problem: Problem, position: np.ndarray | None = None) -> FrameInput:
    """The frame without the points that are something else by their colours, wherever they are.

    Those are colours learned before, or where none were, of the frame itself with the garment at (V, 3) ``position``, metres.
    Where neither is known, or too few points for a search would stay, the frame stays whole. Prints and cuffs like skin leave it,
    because nothing is known of the cloth's place.
    """
    config, palette = problem.config, _palette(frame, problem, position)
    if palette is None:
        return frame
    stays = ~_others(frame.colors, palette, config.segmentation)
    return frame.only(stays) if config.start.least_points <= np.count_nonzero(stays) < len(stays) else frame


def _palette(frame: FrameInput, problem: Problem, position: np.ndarray | None) -> Palette | None:
    """The palette that tells a frame's colours: learned before, or of the frame, its garment at (V, 3) ``position``, metres.

    None where nothing tells them.
    """
    config, palette = problem.config.segmentation, problem.last.palette
    if frame.colors is None or config.points == 0:
        return None
    if palette is None and position is not None:
        palette = _shown(problem, position, None)
    return palette if palette is not None and _enough(palette, config) else None


def learn(problem: Problem, position: np.ndarray, reliability: float) -> Palette | None:
    """The palette after a frame, whose vertices are at (V, 3) ``position``, metres.

    A doubtful frame teaches nothing. Where the things far from the garment are no longer in the colours that were learned, light
    or camera have changed, and all is forgotten.
    """
    known, config = problem.last.palette, problem.config.segmentation
    if config.points == 0:
        return None
    if problem.frame.colors is None or len(problem.frame.points) == 0:
        return known
    shown = _shown(problem, position, known)
    if known is not None and _changed(shown, known, config):
        return None
    if reliability < config.learned_above:
        return known
    if known is None:
        return shown
    kept = np.float32(exp(-problem.dt / config.memory))
    return Palette(*(kept * before + now for before, now in zip(known, shown, strict=True)))


def _shown(problem: Problem, position: np.ndarray, known: Palette | None) -> Palette:
    """The palette of a frame alone, its garment at (V, 3) ``position``, metres.

    ``known`` is the one before, by which colours are told apart; those of the frame if None.
    """
    config, inside, n = problem.config.segmentation, problem.model.inside, len(position)
    frame = problem.frame.only(_sample(problem.frame, position, config, FIRST if known is None else 1))
    nearest, away = nearest_vertices(frame.points, position, config.other_distance)
    cloth = (inside[nearest] == nearest) & (away < _reach(problem))
    counts = np.zeros((2, *CELLS), np.float32)
    kernels.add_colors(frame.colors, cloth, LOGARITHM, counts[CLOTH])
    kernels.add_colors(frame.colors, nearest < 0, LOGARITHM, counts[OTHER])
    alone = Palette(counts, *np.zeros((2, n), np.float32))
    told = alone if known is None else known
    if not _enough(told, config):
        return alone
    alike = _others(frame.colors, told, config)
    seen = (np.bincount(nearest[chosen], minlength=n).astype(np.float32) for chosen in (cloth & alike, cloth))
    return Palette(counts, *seen)


def _sample(frame: FrameInput, position: np.ndarray, config: Segmentation, more: int) -> np.ndarray:
    """Rows of a frame, spread over the points in the garment's box, and as many over those outside."""
    lower, upper = position.min(axis=0) - config.other_distance, position.max(axis=0) + config.other_distance
    boxed = ((frame.points > lower) & (frame.points < upper)).all(axis=1)
    parts = (np.flatnonzero(part) for part in (boxed, ~boxed))
    return np.concatenate([part[spread_rows(len(part), more * config.points)] for part in parts])


def _changed(shown: Palette, known: Palette, config: Segmentation) -> bool:
    """Whether most of what a frame shows of other things has colours that the palette does not know of them."""
    if not _enough(known, config) or shown.counts[OTHER].sum() < config.least_points:
        return False
    of_others = known.counts[OTHER] / known.counts[OTHER].sum() > config.floor
    return float(shown.counts[OTHER][of_others].sum()) < KNOWN * float(shown.counts[OTHER].sum())


def _enough(palette: Palette, config: Segmentation) -> bool:
    """Whether enough points of the garment and of other things were learned."""
    return float(palette.counts.sum(axis=(1, 2, 3)).min()) >= config.least_points


def _others(colors: np.ndarray, palette: Palette, config: Segmentation) -> np.ndarray:
    """(N,) bool: (N, 3) colours that are likelier among other things."""
    likelihoods = palette.counts / palette.counts.sum(axis=(1, 2, 3), keepdims=True) + np.float32(config.floor)
    other = np.empty(len(colors), bool)
    kernels.mark_others(colors, LOGARITHM, likelihoods, config.ratio, other)
    return other


def _reach(problem: Problem) -> float:
    """Metres from a vertex within which points are on its cloth."""
    return problem.config.segmentation.cloth_distance + 0.5 * problem.model.edge_length
