"""Stage E, adaptive stiffness: stretch and shear are as stiff as the strain that the garment keeps showing.

A template is a guess. Simulated cloth keeps its metric within a few per cent; a reconstruction from cameras, whose folds were
smoothed away, does not, and a stiff energy then drives it along the surface. In a MAP problem a stiffness is the inverse of the
strain's prior variance. As stage D does with the measurement's, that variance follows what is left over (compare Mehra 1970,
"On the identification of variances and adaptive Kalman filtering").
"""

from __future__ import annotations

import dataclasses
from math import exp

import numpy as np

from ddakf.config import Config, Physics
from ddakf.kernels import strain as kernels
from ddakf.types import Problem

SOFTEST = 0.02  # least share of the stiffness that is left
LEAST_SHARE = 0.5  # of the faces measured, of which a median says anything about the garment
LONGEST = 0.1  # s that a frame counts for: the first fit after a gap is the least to be trusted


def initial(config: Physics) -> float:
    """The squared strain before the first frame: at it the energies are as stiff as they are said to be."""
    return config.strain_sd**2


def adapted(strain2: float, config: Config) -> Config:
    """The configuration as this garment needs it: stretch and shear times share = strain_sd^2 / strain2, never stiffer.

    What the template does not know of the strain it does not resist either: rings follow 1 - share of ``strain_followed``.

    Args:
        strain2: squared strain of a typical face.
        config: of the tracker.
    """
    physics = config.physics
    share = min(1.0, max(SOFTEST, physics.strain_sd**2 / max(strain2, 1e-12)))
    return dataclasses.replace(
        config,
        physics=dataclasses.replace(
            physics,
            stretch=share * physics.stretch,
            shear=share * physics.shear,
            rest_rigidity=share * physics.rest_rigidity + (1.0 - share) * physics.uneven_rigidity,
            strain_followed=(1.0 - share) * physics.strain_followed,
        ),
    )


def learned(problem: Problem, position: np.ndarray, measured: np.ndarray) -> float:
    """The squared strain after a frame: it follows the median over the faces whose corners were measured.

    The median, since edges of the cloud and tangles strain some faces beyond anything that the cloth does. Where less than
    :data:`LEAST_SHARE` of the faces is measured nothing is learned: a surface seen from one side has free edges all around,
    and the softer it is the more a fast motion strains it.

    Args:
        problem: the frame.
        position: (V, 3) the posterior, metres.
        measured: (V,) bool.
    """
    strain, strain2 = problem.model.strain, problem.last.strain2
    squared = np.empty(len(strain.area))
    n = kernels.squared_strains(position, measured, strain, squared)
    if n < LEAST_SHARE * len(squared):
        return strain2
    old = exp(-min(problem.dt, LONGEST) / problem.config.physics.strain_memory)
    return old * strain2 + (1.0 - old) * float(np.median(squared[:n]))
