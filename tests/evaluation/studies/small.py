"""Small studies of the sample, and systems that fail, stay, or are absent."""

from __future__ import annotations

import numpy as np
from rich.console import Console

from ddakf.errors import NotApplicable
from ddakf.evaluation.studies.study_plan import StudyPlan
from ddakf.evaluation.trials.trial import Trial

SMALL = Trial("", points=800, surfaces=True)
QUIET = Console(quiet=True)


def plan(*systems: str, **how) -> StudyPlan:
    small = {"views": ("full",), "runs": 1, "frames": "0:5", "settings": SMALL}
    return StudyPlan(("sample",), systems or ("ddakf", "nicp"), **small | how)


class Broken:
    """Fails in its third frame."""

    def start(self, garment, vertices, body):
        self.vertices, self.left = vertices, 2

    def step(self, frame):
        self.left -= 1
        if self.left < 0:
            raise np.linalg.LinAlgError("singular")
        return self.vertices


class Frozen(Broken):
    """Stays where it was."""

    def step(self, frame):
        return self.vertices


def absent(scored):
    raise NotApplicable("absent needs a package that is not installed")
