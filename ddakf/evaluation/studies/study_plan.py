"""Plan of a study: every system on every sequence, in every view, with every seed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from ddakf.errors import InvalidArgument
from ddakf.evaluation.datasets import Pair
from ddakf.evaluation.paper_scope import SYSTEMS
from ddakf.evaluation.trials import methods
from ddakf.evaluation.trials.recordings import find_recording, tracked_frames
from ddakf.evaluation.trials.trial import Trial, sensor_of
from ddakf.files.sequence import Sequence
from ddakf.plausibility.units import require_size

_OPTIONS = {"sequences": "SEQ", "systems": "methods", "views": "view"}  # of the command line, by field
LEAST_FRAMES = 4  # of a recording: the start frame, and three tracked ones, which have a second difference


@dataclass(frozen=True)
class StudyPlan:
    """A study.

    Attributes:
        sequences: names or paths, see :func:`ddakf.evaluation.trials.recordings.find_recording`.
        systems: names of :func:`ddakf.evaluation.trials.methods.method_factory`.
        views: ``full``, ``front`` or ``ring4``, with ``+body`` if the systems get the body of every frame.
        runs: seeds 1 to this many.
        frames: ``A:B``, of the recording; the garment is known in frame A.
        settings: common to all trials: those of the sensor, without its view.
    """

    sequences: tuple[str, ...]
    systems: tuple[str, ...] = SYSTEMS
    views: tuple[str, ...] = ("full",)
    runs: int = 5
    frames: str = ":"
    settings: Trial = field(default_factory=lambda: Trial("", surfaces=True))

    def trials(self) -> list[Trial]:
        """All trials, seeds outermost, so that an interrupted study has some runs of every cell."""
        return [
            self._trial(name, view, seed, system)
            for seed in range(1, self.runs + 1)
            for name in self.sequences
            for view in self.views
            for system in self.systems
        ]

    def unheeded(self) -> dict[str, None]:
        """Settings without effect on any of the sequences, as None: recordings of real sensors have noise of their own."""
        virtual = any(isinstance(find_recording(name), Sequence) for name in self.sequences)
        return {} if virtual else {"noise": None}

    def _trial(self, name: str, view: str, seed: int, system: str) -> Trial:
        view, _, body = view.partition("+")
        first, frames = tracked_span(self.frames, self.settings.every)
        own = {"view": view, "body": bool(body), "seed": seed, "variant": system, "first": first, "frames": frames}
        return replace(self.settings, sequence=name, **own)

    def check(self) -> None:
        """Refuses a plan that cannot be run.

        Raises:
            InvalidArgument: no such system or view; settings beyond their range; frames that a sequence does not have; an
                occlusion in none of its frames; errors of a virtual camera for a real recording.
            InvalidFile: a sequence that cannot be read. InvalidMesh: a template that is not in metres.
        """
        for name in ("sequences", "systems", "views"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise InvalidArgument(_OPTIONS[name], "at least one, each once", ", ".join(values) or "none")
        if self.runs < 1:
            raise InvalidArgument("runs", "at least 1", str(self.runs))
        for view in self.views:
            view, plus, body = view.partition("+")
            if plus and body != "body":
                raise InvalidArgument("view", "full, front or ring4, or one of them with +body", repr(view + plus + body))
            sensor_of(replace(self.settings, view=view))
        for system in self.systems:
            _require_method(system)
        for trial in dict.fromkeys(self._trial(name, self.views[0], 1, self.systems[0]) for name in self.sequences):
            _require_frames(trial)
            _require_effect(trial)

    def require_all_frames(self) -> None:
        """Refuses frames beyond the end of a sequence. The paper's studies take what there is.

        Raises:
            InvalidArgument
        """
        last = self.frames.partition(":")[2]
        for name in self.sequences:
            known = find_recording(name)
            if last and not isinstance(known, Pair) and int(last) > len(known):
                raise InvalidArgument("frames", f"at most :{len(known)}, the frames of {name}", repr(self.frames))


def tracked_span(text: str, every: int) -> tuple[int, int | None]:
    """The first frame of ``A:B``, and the most frames to track (None for all)."""
    first, colon, last = text.partition(":")
    if not colon or not all(part == "" or part.isdecimal() for part in (first, last)):
        raise InvalidArgument("frames", "A:B, whole numbers or nothing", repr(text))
    start = int(first or 0)
    return start, None if last == "" else max(int(last) - 1 - start, 0) // every


def _require_method(name: str) -> None:
    try:
        methods.method_factory(name)
    except InvalidArgument as error:
        field = "methods" if error.field == "variant" else f"methods: {error.field}"
        raise InvalidArgument(field, error.expected, error.got) from None


def _require_frames(trial: Trial) -> None:
    tracked = len(tracked_frames(trial))
    if tracked < LEAST_FRAMES - 1:
        raise InvalidArgument(
            f"{trial.sequence}: frames", f"at least {LEAST_FRAMES} from frame {trial.first} on",
            f"{tracked + 1 if tracked else 0}",
        )  # fmt: skip


def _require_effect(trial: Trial) -> None:
    """Refuses settings that have no effect, or would fail in every run."""
    sensor, frames = sensor_of(trial), tracked_frames(trial)
    known = find_recording(trial.sequence)
    if isinstance(known, Pair):
        return
    if not isinstance(known, Sequence):
        sensor.require_no_camera()
        require_size(known.template(frames.start - frames.step), None)  # raises without a template
    if sensor.occlude and not any(map(sensor.occludes, frames)):
        window = "{}:{}".format(*sensor.occlude)
        raise InvalidArgument("occlude", f"some of the frames {frames.start} to {frames[-1]} of {trial.sequence}", window)
