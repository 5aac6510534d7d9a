"""Vertex errors: distances of the estimated vertices from the true ones."""

from __future__ import annotations

import numpy as np

from ddakf.errors import InvalidArgument
from ddakf.mesh import vertex_normals

MM = 1e3  # millimetres per metre


def rmse_mm(estimate: np.ndarray, truth: np.ndarray) -> float:
    """sqrt(mean_i |E_i - T_i|^2) over the vertices (V, 3); millimetres."""
    error = difference(estimate, truth)
    return float(MM * np.sqrt((error**2).sum(axis=1).mean()))


def normal_rmse_mm(estimate: np.ndarray, truth: np.ndarray, faces: np.ndarray) -> float:
    """sqrt(mean_i ((E_i - T_i) . n_i)^2) with the truth's area-weighted unit normals n_i; millimetres.

    The part of the error that changes the shape; the rest slides within the surface.
    """
    along = (difference(estimate, truth) * vertex_normals(np.asarray(truth, np.float64), faces)).sum(axis=1)
    return float(MM * np.sqrt((along**2).mean()))


def tangential_rmse_mm(estimate: np.ndarray, truth: np.ndarray, faces: np.ndarray) -> float:
    """sqrt(mean_i |(I - n_i n_i') (E_i - T_i)|^2): the part of the error that slides within the surface; millimetres.

    rmse_mm^2 = normal_rmse_mm^2 + tangential_rmse_mm^2. Where no face with an area gives a normal, all of the error counts here.
    """
    error, normal = difference(estimate, truth), vertex_normals(np.asarray(truth, np.float64), faces)
    tangential = error - (error * normal).sum(axis=1, keepdims=True) * normal
    return float(MM * np.sqrt((tangential**2).sum(axis=1).mean()))


def second_moment(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(3, 3) mean of e e' over the errors e = E_i - T_i, square metres; means over frames weighted by n are those of all."""
    error = difference(estimate, truth)
    return error.T @ error / max(len(error), 1)


def difference(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    estimate, truth = np.asarray(estimate, np.float64), np.asarray(truth, np.float64)
    if estimate.shape != truth.shape or estimate.ndim != 2 or estimate.shape[1] != 3:
        raise InvalidArgument("estimate", f"shape {truth.shape} as the truth", str(estimate.shape))
    return estimate - truth
