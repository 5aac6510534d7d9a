"""Stage E, adaptive stiffness: stretch and shear are as stiff as the strain that the garment keeps showing.

A template is a guess. Simulated cloth keeps its metric within a few per cent. A reconstruction from cameras, whose folds were
smoothed away, does not, and a stiff energy then drives it along the surface. In a MAP problem a stiffness is the inverse of the
strain's prior variance. That variance follows the residual strain, as stage D's R follows the measurement's (compare Mehra
1970, "On the identification of variances and adaptive Kalman filtering").
"""

from __future__ import annotations

from math import exp

import numpy as np

from ddakf.config import Config, Physics, derived
from ddakf.kernels import strain as kernels
from ddakf.types import Problem


def initial(config: Physics) -> float:
    """The squared strain before the first frame, at which the energies have their configured stiffness."""
    return config.strain_sd**2


def adapted(strain2: float, config: Config) -> Config:
    """Configuration for this garment: stretch and shear times share = strain_sd^2 / strain2, at most 1.

    The template does not resist strain that it does not know: one-rings follow 1 - share of ``strain_followed``.

    Args:
        strain2: squared strain of a typical face.
        config: of the tracker.
    """
    physics = config.physics
    share = min(1.0, max(physics.softest, physics.strain_sd**2 / max(strain2, 1e-12)))
    return derived(
        config,
        physics=derived(
            physics,
            stretch=share * physics.stretch,
            shear=share * physics.shear,
            rest_rigidity=share * physics.rest_rigidity + (1.0 - share) * physics.uneven_rigidity,
            strain_followed=(1.0 - share) * physics.strain_followed,
        ),
    )


def learn(problem: Problem, position: np.ndarray, measured: np.ndarray) -> float:
    """The squared strain after a frame: it follows the median over the faces whose corners were measured.

    The median is used because edges of the cloud and tangles strain some faces more than the cloth itself. Nothing is learned
    while less than ``strain_coverage`` of the faces is measured: a surface seen from one side has free edges all around, and the
    softer it is, the more a fast motion strains it. A frame counts for at most ``longest_lesson``, as the first fit after a gap
    is the least reliable.

    Args:
        problem: the frame.
        position: (V, 3) the posterior, metres.
        measured: (V,) bool.
    """
    strain2, config = problem.last.strain2, problem.config.physics
    strain = problem.model.strain if problem.resting is None else problem.resting.strain
    squared = np.empty(len(strain.area))
    n = kernels.squared_strains(position, measured, strain, squared)
    if n == 0 or n < config.strain_coverage * len(squared):
        return strain2
    old = exp(-min(problem.dt, config.longest_lesson) / config.strain_memory)
    return old * strain2 + (1.0 - old) * _median(squared[:n])


def _median(values: np.ndarray) -> float:
    """Median of (N,) values, N > 0. Of one partition, which NumPy does with vector instructions; of two it does not."""
    middle = len(values) // 2
    parted = np.partition(values, middle)
    return float(parted[middle] if len(values) % 2 else 0.5 * (parted[:middle].max() + parted[middle]))
