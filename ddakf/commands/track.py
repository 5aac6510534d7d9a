"""``ddakf track``: tracks a garment through a sequence or a recording, and reports how well."""

from __future__ import annotations

import argparse
import json
import math
import os
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from ddakf.commands import sensor_options
from ddakf.commands.live import LiveView
from ddakf.commands.remote import server_options
from ddakf.errors import DdakfError, InvalidArgument, shown

EPILOG = """
A sequence (.npz, a clip of FAUST, a garment of CLOTH3D) has the true garment: it is seen by a virtual sensor, and errors are
reported. A recording (.mat of UTD-MHAD, a folder with depth/*.png, or one of .ply, .obj, .xyz or .pcd files) has none: the
distance of the cloud to the fitted surface is reported. Of several parts one is named: MPI-FAUST#s3_p7, 00042#Tshirt.
"""


FPS = 30.0  # frames per second of a recording that does not state them
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}  # metres


def register(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = commands.add_parser("track", help="track a garment through a sequence or recording", epilog=EPILOG)
    parser.add_argument(
        "path", metavar="NAME|SEQ.npz|DEPTH.mat|FOLDER[#PART]", help="sample, another name that ddakf evaluate takes, or a path"
    )
    parser.add_argument("--frames", default=":", metavar="A:B", help="frames that are tracked: from A up to B - 1")
    parser.add_argument("--seed", type=int, default=1, help="seed of the sensor's random numbers (default 1)")

    sensor = sensor_options.add(parser)
    sensor.add_argument("--fps", type=float, help=f"frames per second of a recording that does not state them (default {FPS:g})")
    sensor.add_argument(
        "--sensor-origin",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="place of the camera of a folder of clouds, in the files' unit (default: as a .pcd's VIEWPOINT or a .ply's "
        "comment sensor_origin says)",
    )

    sensor.add_argument("--unit", choices=UNITS, help="unit of a folder of clouds and of its template (default m)")
    sensor.add_argument("--template-unit", choices=UNITS, help="unit of the file of --template (default that of --unit)")

    tracker = parser.add_argument_group("tracker")
    tracker.add_argument(
        "--body", action=argparse.BooleanOptionalAction, default=False, help="give the tracker the body of every frame"
    )
    tracker.add_argument(
        "--start",
        choices=("truth", "rest", "search"),
        help="the template of a sequence lies at the true first frame (default), as it is in the "
        "file, or turned and moved away at random, so that the tracker has to search",
    )
    tracker.add_argument("--template", metavar="FILE", help="mesh to track in a recording (default: its first frame)")
    tracker.add_argument("--paper", action="store_true", help="track with Config.paper(), the paper's method as printed")
    tracker.add_argument("--config", metavar="JSON", help="""parts of the configuration, such as '{"start": {"up": "z"}}'""")
    tracker.add_argument("--fabric", metavar="NAME", help="fabric of the garment: cotton, silk, jersey, wool or denim")

    remote = parser.add_argument_group("server")
    server_options.add(remote, server=None, meaning="track on the server with this gRPC address, through its client")
    remote.add_argument("--codec", metavar="NAME", help="codec of the clouds that are sent to the server")

    output = parser.add_argument_group("output")
    output.add_argument("--out", metavar="R.npz", help="file for the result: vertices, sigma, reliability, states, timestamps")
    output.add_argument(
        "--meshes", metavar="FOLDER", help="existing folder into which the garment of each frame is written, as NUMBER.obj"
    )
    output.add_argument("--picture", metavar="P.png", help="file for a picture of the middle frame")
    output.add_argument("--animation", metavar="P.gif|P.webp", help="file for an animation of the run")
    output.add_argument("--live", action="store_true", help="show reliability, rate and times of stages while it tracks")
    output.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Tracks, reports, and writes what was asked for."""
    from ddakf.evaluation.tracking.scoreboard import Scoreboard

    _check_outputs(arguments)
    console, config = Console(stderr=True), _config(arguments)
    source = _source(arguments)
    if source.vertex_map is not None:
        console.print(f"The template was repaired: {len(source.vertex_map)} vertices; --out has the vertex_map", soft_wrap=True)
    scores = Scoreboard(source.garment)
    album = _Album(len(source)) if arguments.picture or arguments.animation else None
    replayed = _replay(arguments, source, config, console)
    try:
        with LiveView(source.title, len(source), console) if arguments.live else _Bar(source.title, len(source), console) as view:
            for frame, result, seconds in replayed:
                scores.add(frame, result, seconds)
                if album:
                    album.add(frame, result)
                view.add(result, seconds)
    except (DdakfError, KeyboardInterrupt):
        if done := scores.summary()["frames"]:
            console.print(f"The run ends early: the results are of {done} of {len(source)} frames", soft_wrap=True)
            _report(arguments, source, scores, album)
        raise
    _report(arguments, source, scores, album)
    _doubt_axes(arguments, source, config, scores.summary(), console)
    if scores.summary()["empty_frames"] == len(source):
        got = f"{arguments.path}, all of whose {len(source)} have none"
        raise InvalidArgument("path", "frames with points of the garment", got)
    return 0


def _report(arguments: argparse.Namespace, source, scores, album: _Album | None) -> None:
    """Writes what was asked for, and prints the summary. What cannot be written costs nothing else."""
    failures = []
    for wanted, save in (
        (arguments.out, lambda: scores.save(arguments.out, source.vertex_map)),
        (arguments.meshes, lambda: _save_meshes(arguments.meshes, scores)),
        (album, lambda: album.save(source, arguments.picture, arguments.animation)),
    ):
        try:
            if wanted:
                save()
        except OSError as error:  # that of a write has no name
            name = error.filename or (wanted if isinstance(wanted, str) else arguments.picture or arguments.animation)
            failures.append(OSError(error.errno, error.strerror, name))
    summary = scores.summary()
    print(json.dumps(summary)) if arguments.json else Console().print(table(source.title, summary))
    if failures:
        raise failures[0]


def _doubt_axes(arguments: argparse.Namespace, source, config, summary: dict, console: Console) -> None:
    """Says after a search in vain how the template has to be turned, if that helps."""
    import ddakf
    from ddakf.evaluation.tracking import axes

    searched = source.start is None and summary["rmse_mm"] is None  # in a recording, whose axes nobody knows
    if arguments.server or arguments.paper or not searched or summary["empty_frames"] == len(source):
        return
    if summary["reliability"] >= axes.DOUBTED:
        return
    console.print("The template was hardly found: turns of it are tried", soft_wrap=True)
    if said := axes.fitting_turn(source, config or ddakf.Config()):
        console.print(said, markup=False, soft_wrap=True)


def _save_meshes(folder: str, scores) -> None:
    written = set(scores.save_meshes(folder))
    if others := [path for path in Path(folder).glob("*.obj") if path.stem.isdecimal() and path not in written]:
        sentence = f"{folder}: {len(others)} other numbered meshes lie there, of another run"
        Console(stderr=True).print(sentence, markup=False, soft_wrap=True)


def table(title: str, summary: dict) -> Table:
    """The summary of a :class:`~ddakf.evaluation.tracking.scoreboard.Scoreboard` for people."""
    rows = Table(title=Text(title), show_header=False, title_justify="left")
    rows.add_row("frames", str(summary["frames"]))
    if summary["empty_frames"]:
        rows.add_row("frames without points", str(summary["empty_frames"]))
    rows.add_row("states", ", ".join(f"{state} {share:.1%}" for state, share in summary["states"].items()))
    rows.add_row("time per frame, p50 / p99", f"{summary['ms_p50']:.1f} / {summary['ms_p99']:.1f} ms")
    rows.add_row("frames per second", f"{summary['fps']:.0f}")
    if summary["rmse_mm"] is not None:
        rows.add_row("RMSE / along the normal", f"{summary['rmse_mm']:.1f} / {summary['normal_rmse_mm']:.1f} mm")
        for name, label in (("", "all"), ("_observed", "observed"), ("_hidden", "unobserved")):
            coverage, nees = summary["coverage90" + name], summary["nees3" + name]
            if coverage is not None:
                rows.add_row(f"in 90 % ellipsoid, NEES/3: {label}", f"{coverage:.1%}, {nees:.2f}")
    if summary["residual_mean_mm"] is not None:
        residual = f"{summary['residual_mean_mm']:.1f} / {summary['residual_p95_mm']:.1f} mm"
        rows.add_row("cloud to surface, mean / p95", residual)
    rows.add_row("reliability, mean", f"{summary['reliability']:.2f}")
    for warning in summary["warnings"]:
        rows.add_row(f"warning in {warning['frames']} frames", f"{warning['field']}: {warning['message']} ({warning['code']})")
    return rows


class _Album:
    """Keeps what the pictures need, of at most as many frames as an animation shows."""

    def __init__(self, frames: int):
        from ddakf.evaluation.drawing.pictures import MOST_FRAMES

        self._stride, self._seen, self._shots, self._origin = math.ceil(frames / MOST_FRAMES), 0, [], None

    def add(self, frame, result) -> None:
        from ddakf.evaluation.drawing.pictures import Shot

        if self._seen % self._stride == 0:
            caption = f"frame {frame.number}   {result.state}   reliability {result.reliability:.2f}"
            vertices, sigma = result.vertices.copy(), result.sigma.copy()
            self._shots.append(Shot(frame.points, vertices, sigma, caption, frame.body))
        self._seen += 1
        if self._origin is None and frame.sensor_origin is not None and frame.sensor_origin.ndim == 1:
            self._origin = frame.sensor_origin

    def save(self, source, picture: str | None, animation: str | None) -> None:
        from ddakf.evaluation.drawing import pictures

        painter = pictures.Painter(
            self._shots,
            source.garment.faces,
            source.body_faces,
            title=source.title,
            sensor_origin=self._origin,
            see_behind=source.closed,
        )
        if picture:
            pictures.save_still(picture, painter, self._shots[len(self._shots) // 2])
        if animation:
            pictures.save_animation(animation, painter, self._shots, source.fps / self._stride)


def _check_outputs(arguments: argparse.Namespace) -> None:
    """Refuses before the run what could not be written after it."""
    if arguments.animation and not arguments.animation.lower().endswith((".gif", ".webp")):
        raise InvalidArgument("animation", "a name that ends in .gif or .webp", arguments.animation)
    inputs = {Path(given).resolve() for given in (arguments.path.partition("#")[0], arguments.path, arguments.template) if given}
    outputs: set[Path] = set()
    for name in ("out", "picture", "animation"):
        path = getattr(arguments, name)
        if path and (Path(path).is_dir() or not Path(path).parent.is_dir()):
            raise InvalidArgument(name, "a file in a folder that exists", path)
        if path and not os.access(path if Path(path).exists() else Path(path).parent, os.W_OK):
            raise InvalidArgument(name, "a file that may be written", path)
        if path and Path(path).resolve() in outputs:
            raise InvalidArgument(name, "another file than the other results", path)
        outputs |= {Path(path).resolve()} if path else set()
        if path and Path(path).resolve() in inputs:
            raise InvalidArgument(name, "another file than those that are tracked", path)
        if path and Path(path).exists() and any(given in Path(path).resolve().parents for given in inputs):
            raise InvalidArgument(name, "a file that does not exist yet in the folder that is tracked", path)
    if arguments.meshes and not (Path(arguments.meshes).is_dir() and os.access(arguments.meshes, os.W_OK)):
        raise InvalidArgument("meshes", "a folder that exists and may be written to", arguments.meshes)
    if arguments.meshes and Path(arguments.meshes).resolve() in inputs:
        raise InvalidArgument("meshes", "another folder than that of the frames", arguments.meshes)
    if arguments.picture or arguments.animation:
        _require_formats(arguments.picture)
    if not arguments.server:
        for name in ("codec", *server_options.given(arguments)):
            if getattr(arguments, name) is not None:
                raise InvalidArgument(name, "to be used with --server", "none of it")


def _require_formats(picture: str | None) -> None:
    """Refuses a picture of an unknown format, and any picture where nothing paints them."""
    from ddakf.evaluation.drawing.pictures import writable_formats

    known = writable_formats()
    if picture and (suffix := Path(picture).suffix.lower()) not in known:
        raise InvalidArgument("picture", f"a name that ends in .png or another of {len(known)} formats", suffix or picture)


def _recording(path: str, fps: float):
    """What is at a path, or the recording of a name."""
    from ddakf.evaluation.datasets import open_dataset
    from ddakf.evaluation.trials.recordings import find_recording

    place = Path(path.partition("#")[0])
    is_name = not place.exists() and len(place.parts) == 1 and not place.suffix
    return find_recording(path) if is_name else open_dataset(path, fps=fps)


def _source(arguments: argparse.Namespace):
    if arguments.seed < 0:
        raise InvalidArgument("seed", "a number from 0", str(arguments.seed))
    from ddakf.evaluation.datasets.captures.cloud_folder import FolderRecording
    from ddakf.evaluation.tracking.sources import source_of
    from ddakf.files.sequence import Sequence
    from ddakf.plausibility.units import LARGEST

    recording = _recording(arguments.path, FPS if arguments.fps is None else arguments.fps)
    if isinstance(recording, Sequence) and arguments.fps is not None:
        raise InvalidArgument("fps", "none for a sequence, which has its own", f"{arguments.fps:g}")
    if arguments.fps is not None and (recording.times is not None or recording.fps != arguments.fps):
        raise InvalidArgument("fps", "none for a recording that states its own", f"{arguments.fps:g}")
    if arguments.start is not None and not isinstance(recording, Sequence):
        expected = "none for a recording, whose template is searched in the first frame if it does not lie there"
        raise InvalidArgument("start", expected, arguments.start)
    if arguments.sensor_origin is not None:
        recording = _placed(recording, arguments.sensor_origin)
    if arguments.template_unit and not arguments.template:
        raise InvalidArgument("template_unit", "to be used with --template", "none of it")
    unit = UNITS[arguments.unit or "m"]
    template_unit = UNITS[arguments.template_unit] if arguments.template_unit else unit
    if arguments.unit:
        recording = replace(_folder_of_clouds(recording, "unit"), unit=unit)
    source = source_of(
        recording,
        sensor_options.sensor(arguments, virtual=isinstance(recording, Sequence)),
        frames=arguments.frames,
        start=arguments.start or "truth",
        give_body=arguments.body,
        template=arguments.template,
        unit=template_unit,
        seed=arguments.seed,
    )
    if template_unit == UNITS["m"] and isinstance(recording, FolderRecording) and (size := source.garment.size) > LARGEST:
        known, got = ", ".join(UNITS), f"metres, in which the garment is {size:.3g} in size"
        if arguments.template and not arguments.template_unit:
            got += " (--template-unit is that of the template alone)"
        raise InvalidArgument("template_unit" if arguments.template_unit else "unit", f"that of the files, one of {known}", got)
    if not len(source):
        raise InvalidArgument("every", "frames to track after the first one", f"--every {arguments.every}, which leaves none")
    return source


def _placed(recording, sensor_origin: list[float]):
    """A folder of clouds whose camera stood at these (3,) coordinates."""
    recording = _folder_of_clouds(recording, "sensor_origin")
    if not all(map(math.isfinite, sensor_origin)):
        raise InvalidArgument("sensor_origin", "three finite numbers", " ".join(map(str, sensor_origin)))
    return replace(recording, sensor_origin=tuple(sensor_origin))


def _folder_of_clouds(recording, option: str):
    """The recording, which an option is for."""
    from ddakf.evaluation.datasets.captures.cloud_folder import FolderRecording

    if not isinstance(recording, FolderRecording):
        raise InvalidArgument(option, "a folder of clouds; other recordings state their own", recording.name)
    return recording


def _config(arguments: argparse.Namespace):
    """The configuration of the options; None: the default."""
    import ddakf

    if arguments.paper and arguments.config:
        raise InvalidArgument("config", "none with --paper", shown(arguments.config))
    config = ddakf.Config.paper() if arguments.paper else None
    if arguments.config:
        try:
            config = ddakf.Config.from_dict(json.loads(arguments.config))
        except json.JSONDecodeError:
            raise InvalidArgument("config", "a JSON object", shown(arguments.config)) from None
    if arguments.fabric:
        config = (config or ddakf.Config()).with_fabric(ddakf.Fabric.named(arguments.fabric))
    return config


def _replay(arguments: argparse.Namespace, source, config, console: Console):
    from ddakf.commands.doctor import warm
    from ddakf.evaluation.tracking import replay

    if arguments.server:
        return replay.remote(source, server_options.server_of(arguments), config, arguments.codec)
    warm(console)
    return replay.local(source, config)


class _Bar:
    """A progress bar with the rate and the reliability of the last frame, as a context."""

    def __init__(self, title: str, frames: int, console: Console):
        columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
                   TextColumn("{task.fields[note]}"))  # fmt: skip
        self._progress = Progress(*columns, console=console)
        self._task = self._progress.add_task(title, total=frames, note="")

    def __enter__(self) -> _Bar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def add(self, result, seconds: float) -> None:
        note = f"{1 / seconds:4.0f} fps  reliability {result.reliability:.2f}"
        self._progress.update(self._task, advance=1, note=note)
