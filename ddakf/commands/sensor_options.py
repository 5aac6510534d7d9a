"""The options of a virtual sensor on the command line, the same for every command that has one."""

from __future__ import annotations

import argparse
import re

from ddakf.errors import InvalidArgument

VIRTUAL_NOISE_MM = 3.0  # added to a virtual sensor's points unless told otherwise; a real one has its own noise
MM = 1e-3  # metres


def add(parser: argparse.ArgumentParser, *, several_views: bool = False) -> argparse._ArgumentGroup:
    """Adds the options to a parser, as a group to which more can be added.

    Args:
        parser: of the command.
        several_views: ``--view`` is a list, of all around, with ``+body`` where a method is told the body.
    """
    group = parser.add_argument_group("sensor")
    if several_views:
        what = "views: full (points all around), front (one depth camera), ring4 (four); with +body the systems get the body"
        group.add_argument("--view", default="full", metavar="V,W", help=f"{what} (default full)")
    else:
        what = "views of a sequence: full (points all around), front (one depth camera, the default) or ring4 (four)"
        group.add_argument("--view", choices=("full", "front", "ring4"), help=what)
    group.add_argument(
        "--points", type=int, default=10_000, metavar="N", help="at most this many points per frame (default 10000)"
    )
    group.add_argument(
        "--noise-mm",
        type=float,
        metavar="MM",
        help="standard deviation of the noise that is added to the points (default: 3 for sequences, 0 for recordings)",
    )
    group.add_argument("--drop", type=float, default=0.0, metavar="SHARE", help="share of the points that are lost at random")
    group.add_argument(
        "--outliers", type=float, default=0.0, metavar="SHARE", help="share of the points that are replaced by outliers"
    )
    group.add_argument(
        "--depth-noise-mm",
        type=float,
        default=0.0,
        metavar="MM",
        help="noise of a depth camera at 1 m, which grows with the square of the depth (1.4: first Kinect)",
    )
    group.add_argument(
        "--depth-step-mm",
        type=float,
        default=0.0,
        metavar="MM",
        help="step of a depth camera's values at 1 m, which grows with the square of the depth (2.9: first Kinect)",
    )
    group.add_argument(
        "--fliers", type=float, default=0.0, metavar="SHARE", help="share of the pixels at depth edges that mix both depths"
    )
    group.add_argument("--occlude", metavar="FROM:TO", help="frames in which the wearer's left side is hidden")
    group.add_argument(
        "--occluded", type=float, metavar="SHARE", help="share of the garment that --occlude hides (default 0.4)"
    )
    group.add_argument("--every", type=int, default=1, metavar="N", help="take every N-th frame only (default 1)")
    return group


def sensor(arguments: argparse.Namespace, virtual: bool = True, view: str | None = None):
    """The :class:`ddakf.evaluation.sensors.virtual_sensor.Sensor` of parsed options.

    Args:
        arguments: with those of :func:`add`.
        view: one of several; default the one of the options.
        virtual: it looks at a sequence; otherwise the points are of a real sensor.

    Raises:
        InvalidArgument: a value out of its range, a view of a real sensor, or a share of no occlusion.
    """
    from ddakf.evaluation.sensors import Sensor

    if not virtual and arguments.view is not None:
        raise InvalidArgument("view", "none for a recording, whose sensor saw what it saw", arguments.view)

    for name in ("noise_mm", "depth_noise_mm", "depth_step_mm"):  # a message of Sensor's would be in metres
        if (given := getattr(arguments, name)) is not None and not 0 <= given < 1000:
            raise InvalidArgument(name, "millimetres in [0, 1000)", str(given))
    if arguments.occluded is not None and arguments.occlude is None:
        raise InvalidArgument("occluded", "to be used with --occlude", "none of it")
    noise_mm = arguments.noise_mm
    if noise_mm is None:
        noise_mm = VIRTUAL_NOISE_MM if virtual else 0.0
    return Sensor(
        view=view or arguments.view or Sensor().view,
        points=arguments.points,
        noise=noise_mm * MM,
        drop=arguments.drop,
        outliers=arguments.outliers,
        depth_noise=arguments.depth_noise_mm * MM,
        depth_step=arguments.depth_step_mm * MM,
        fliers=arguments.fliers,
        occlude=None if arguments.occlude is None else window(arguments.occlude),
        occluded=Sensor().occluded if arguments.occluded is None else arguments.occluded,
        every=arguments.every,
    )


def window(text: str) -> tuple[int, int]:
    """(FROM, TO) of ``FROM:TO``: frames FROM to TO - 1.

    Raises:
        InvalidArgument: not of that form.
    """
    if not (found := re.fullmatch(r"(\d{1,9}):(\d{1,9})", text)):
        raise InvalidArgument("occlude", "FROM:TO, two frame numbers", repr(text))
    return int(found[1]), int(found[2])
