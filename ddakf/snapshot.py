"""Snapshot: a track to and from bytes, versioned, checked, exact to the bit on the next step."""

from __future__ import annotations

import io
import itertools
import json
import math
import struct
import zipfile
import zlib
from dataclasses import replace
from typing import get_args

import numpy as np

from ddakf.appearance import colour
from ddakf.body import body_anchor
from ddakf.body.proximity import Contact
from ddakf.config import Config
from ddakf.errors import InvalidSnapshot
from ddakf.kernels.segmentation import CELLS
from ddakf.mesh import Mesh
from ddakf.physics import rigidity
from ddakf.planning.work import Costs, Rate
from ddakf.plausibility import sensor_poses
from ddakf.results import TrackerState, WarningCode
from ddakf.stages.frame_input import MAX_SENSORS, MAX_TIME
from ddakf.types import (
    Appearance,
    BodyAnchor,
    BodyModel,
    BodyTrack,
    Contacts,
    Drift,
    Health,
    Palette,
    Resting,
    Sensors,
    State,
    Track,
    View,
)

MAGIC = b"DDAKFSNP"
LARGEST_NUMBER = 1e6  # of the state and of the body: m, m/s, their squares, faces
LARGEST_VARIANCE = 1e4  # m^2, m^2/s^2
MOST_INFORMATION = 1e15  # 1/m^2, or 1/m, of the sensors' places
MOST = 1 << 31  # of a count
MAX_BYTES = 1 << 28  # of an unpacked snapshot: 100,000 vertices over as large a body take less than half of it
VERSION = 28
# 11 lacks the last frame's reliability, which begins at 0: the frame that follows is held against none, and errors do not
# fade in it; 12 has a law of the vertices' errors, and 13 another law of the frame's, which are not read; 14 has other laws
# of the error's size, which are not read, and lacks the offset of hidden cloth; 15 has learned how far cloth slips on the
# body as well; 16 has another guess of how far it deviates along the normal, which is not read, and the template's lengths at
# rest; 17 has another law of the frame's error, which is not read; 18 has other names for fields of the configuration; 19 has
# none for the rigidity of coarse meshes, which is the default's; 20 lacks two of colours; 21 has other laws of the error's
# size and of the frame's error, and 22 of the size, which are not read; 23 has no palette; 24 has two more slacks of the
# size; 25 lacks the gap between rim and cloud, which begins at 0; 26 lacks the time of which the body's velocities are a
# mean, as well; 27 has another law of the turns that nothing
# shows, which is not read, and lacks their speed.
READ = range(11, VERSION + 1)
LEARNED = ("seen", "squares", "measured")  # of the body anchor
DROPPED = {
    17: (
        ("evidence", "free_clearance"),
        ("reliability", "sigma_share"),
        *(("predict", f"worn_{name}") for name in ("normal_sd", "slope", "sd", "tangential_sd")),
        *(("predict", f"anchor_{name}") for name in ("normal_samples", "tangential_samples", "seen_samples", "seen_sd")),
        *(("predict", f"anchor_{name}") for name in ("first_share", "slippage", "slippage_power")),
    ),
    25: (("physics", "size_slack_one_side"), ("physics", "size_pull")),
    28: (("uncertainty", "missed_turn"),),
}  # parts and fields of configurations before a version, which are not read
MOVED = {  # part and field of the configuration before 19, and since
    ("predict", "worn_memory"): ("anchor", "memory"),
    ("predict", "worn_normal_sd"): ("anchor", "normal_sd"),
    ("predict", "worn_slope"): ("anchor", "clearance_slope"),
    ("predict", "worn_hanging"): ("anchor", "hanging_slope"),
    ("predict", "slip_sd"): ("anchor", "slip_sd"),
    ("predict", "slip_slope"): ("anchor", "slip_slope"),
    ("predict", "anchor_reach"): ("anchor", "reach"),
    ("predict", "anchor_least_sd"): ("anchor", "least_sd"),
    ("predict", "anchor_first_share"): ("anchor", "first_share"),
    ("associate", "still"): ("associate", "reassociation_motion"),
    ("associate", "beside"): ("associate", "lateral_gate"),
    ("associate", "turned"): ("associate", "normal_distance"),
    ("associate", "sighting"): ("associate", "visibility_motion"),
}
COARSEST = 1000.0  # edges of a template over the working ones: none is coarser
LARGEST = 3.0  # of the logarithm of a stretch
ROUNDING = 1e-3  # of covariances and rotations that are right
SEEN = {"mean": -math.inf, "weight": 0.0, "registered2": 1e-12, "noise2": 0.0}  # of the appearance, at least
FOUND = ("origin", "shift", "information", "vector")  # of the sensors


def save(tracker, level: int) -> bytes:
    """The bytes of a tracker, compressed at a level of zlib, 0 to 9; 0 does not compress and is ten times as fast as 1."""
    return pack(*parts(tracker), level)


def load(data: bytes, kind):
    """The tracker of class ``kind`` that :func:`save` wrote."""
    return build(*unpack(data), kind)


def parts(tracker) -> tuple[dict, dict[str, np.ndarray]]:
    """Configuration, meshes and the track: numbers, and arrays by name."""
    track = tracker._track
    arrays = {f"state_{name}": value for name, value in track.state._asdict().items()}
    arrays |= {"rotation": track.rotation, "drift_covariance": track.drift.covariance}
    arrays |= {"garment_V": tracker.garment.vertices, "garment_F": tracker.garment.faces}
    if track.anchor is not None:
        arrays |= {"worn_pose": track.anchor.bound.pose, "worn_position": track.anchor.bound.position}
        arrays |= {f"worn_{name}": getattr(track.anchor, name) for name in LEARNED}
        if track.anchor.across is not None:
            arrays["worn_across"] = track.anchor.across
    arrays["size"] = track.size
    if track.resting is not None:
        arrays["resting_size"] = track.resting.size
        if track.resting.given:
            arrays["resting_position"] = track.resting.position
    if track.offset is not None:
        arrays["offset"] = track.offset
    if track.appearance is not None:
        arrays |= {f"appearance_{name}": getattr(track.appearance, name) for name in SEEN}
    if track.palette is not None:
        arrays |= {f"palette_{name}": array for name, array in track.palette._asdict().items()}
    if track.body is not None:
        arrays |= {"body_V": tracker.body.vertices, "body_F": tracker.body.faces, **_body_arrays(track.body)}
    if track.sensors is not None:
        arrays |= {f"sensors_{name}": getattr(track.sensors, name) for name in FOUND}
    numbers = {"config": tracker.config.to_dict(), "health": track.health._asdict(), "time": track.time}
    drift = track.drift
    numbers["drift"] = [drift.speed2, drift.stored2, drift.hem2, drift.unseen_turn, drift.turning]
    arrays["drift_missed"] = drift.missed
    numbers["elasticity"] = track.strain2
    numbers["view"], numbers["signs"] = track.view._asdict(), dict(track.signs)
    numbers["sensors"] = None if track.sensors is None else [track.sensors.time, track.sensors.wait]
    numbers["costs"] = track.costs
    return numbers, arrays


def build(numbers: dict, arrays: dict[str, np.ndarray], kind):
    """The inverse of :func:`parts`, of trackers of class ``kind``; the tracker keeps the arrays.

    Raises:
        InvalidSnapshot: parts that do not fit together.
    """
    try:
        body = Mesh(arrays["body_V"], arrays["body_F"]) if "body_V" in arrays else None
        config = Config.from_dict(numbers["config"])
        garment = Mesh(arrays["garment_V"], arrays["garment_F"])
        tracker = kind(garment, body=body, config=config)
        if len(tracker._track.state.position) != len(arrays["state_position"]):
            tracker = kind(garment, body=body, config=_with_coarse_templates(config))
        first = tracker._track
        state = {name: like(getattr(first.state, name), arrays, f"state_{name}") for name in State._fields}
        _require_covariances("state_R", state["R"])
        P_pp, P_pu, P_uu = (state[block] for block in ("P_pp", "P_pu", "P_uu"))
        _require_covariances("state_P", np.block([[P_pp, P_pu], [P_pu.transpose(0, 2, 1), P_uu]]))
        time = _time(numbers["time"])
        tracker._track = Track(
            state=State(**state),
            rotation=_rotation(first.rotation, arrays),
            drift=_drift(first.drift, arrays, numbers["drift"]),
            strain2=_strain2(numbers["elasticity"]),
            health=_health(numbers["health"]),
            time=time,
            body=None if body is None else _body(tracker._setup.body, arrays, tracker._setup.model.mesh.n_vertices),
            anchor=_anchor(tracker, arrays) if "worn_pose" in arrays and body is not None else None,
            view=_view(numbers["view"]),
            sensors=_sensors(arrays, numbers.get("sensors"), time),  # absent from earlier snapshots
            signs=_signs(numbers["signs"]),
            costs=_costs(numbers.get("costs")),  # absent from earlier snapshots
            resting=_resting(tracker, arrays),
            size=_size(arrays, "size"),
            appearance=_appearance(tracker, arrays),
            palette=_palette(tracker, arrays) if "palette_counts" in arrays else None,
            offset=like(first.state.position, arrays, "offset") if "offset" in arrays else None,
        )
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise InvalidSnapshot("snapshot", "the state of a tracker", str(error)) from None
    return tracker


def _with_coarse_templates(config: Config) -> Config:
    """The configuration by which coarse templates are tracked themselves, as before their long edges were split."""
    return replace(config, discretisation=replace(config.discretisation, working_coarsest=COARSEST))


def _body_arrays(track: BodyTrack) -> dict[str, np.ndarray]:
    arrays = {"contact_vertices": track.vertices, "contact_present": np.array(track.present)}
    arrays |= {"contact_turn": np.array(track.turn), "contact_span": np.array(track.span)}
    if track.velocity is not None:
        arrays["contact_velocity"] = track.velocity
    if track.motion is not None:
        arrays |= {"contact_motion": track.motion, "contact_unposed": np.array(track.unposed)}
    if track.contacts is not None:
        arrays |= {f"contact_{name}": value for name, value in track.contacts.closest._asdict().items()}
        arrays["contact_asked_at"] = track.contacts.asked_at
    if track.gap is not None:
        arrays["contact_gap"] = track.gap
    return arrays | {"contact_intruded": np.array(track.intruded)}


def _body(body: BodyModel, arrays: dict[str, np.ndarray], n: int) -> BodyTrack:
    """The inverse of :func:`_body_arrays`, of a garment of ``n`` vertices.

    Raises:
        ValueError: arrays that do not belong to this body and garment.
    """
    of_body, vectors, numbers = body.mesh.vertices, np.zeros((n, 3)), np.zeros(n)
    models = {"vertices": of_body, "motion": of_body.astype(np.float32), "velocity": vectors, "gap": numbers}
    models |= {"face": np.zeros(n, np.int32), "barycentric": vectors, "point": vectors, "normal": vectors, "distance": numbers}
    models["asked_at"] = vectors
    found = {name: _bounded(arrays.get(f"contact_{name}"), name, model) for name, model in models.items()}
    contacts = None
    if (face := found["face"]) is not None:
        if face.min() < -1 or face.max() >= len(body.tree.faces):
            raise ValueError("contact_face is no face of the body")
        contacts = Contacts(Contact(*(arrays[f"contact_{name}"] for name in Contact._fields)), arrays["contact_asked_at"])
    vertices, present = arrays["contact_vertices"], bool(arrays["contact_present"])
    turn = int(arrays.get("contact_turn", 0))  # this and the next are absent from earlier snapshots
    unposed, span = (float(arrays.get(f"contact_{name}", 0.0)) for name in ("unposed", "span"))
    intruded = tuple(arrays.get("contact_intruded", np.zeros(2)).tolist())
    if len(intruded) != 2 or not all(0.0 <= value <= MAX_TIME for value in (unposed, span, *intruded)) or not 0 <= turn < MOST:
        raise ValueError("contact_unposed, contact_span, contact_turn or contact_intruded is no number that is not negative")
    return BodyTrack(
        vertices, present, found["velocity"], contacts, found["gap"], turn, found["motion"], unposed, span, intruded
    )


def _bounded(array: np.ndarray | None, name: str, model: np.ndarray) -> np.ndarray | None:
    """The array, if there is one, which must have the shape and type of ``model`` and numbers that a body can have.

    Raises:
        ValueError: others.
    """
    if array is None or (array.shape == model.shape and array.dtype == model.dtype and _possible(array, name).all()):
        return array
    what = f"{model.dtype} of shape {model.shape}, up to {LARGEST_NUMBER:g}"
    raise ValueError(f"contact_{name}: expected {what}, got {array.dtype} of shape {array.shape}")


def _possible(array: np.ndarray, name: str) -> np.ndarray:
    return (np.abs(array) <= LARGEST_NUMBER) | ((name == "distance") & (array == np.inf))  # of a vertex without a closest point


def like(model: np.ndarray, arrays: dict[str, np.ndarray], name: str, largest: float = LARGEST_NUMBER) -> np.ndarray:
    """The array of this name, which must have the shape and type of ``model`` and numbers up to ``largest``."""
    array = arrays[name]
    if array.shape != model.shape or array.dtype != model.dtype or not (np.abs(array) <= largest).all():
        what = f"{model.dtype} of shape {model.shape}, up to {largest:g}"
        raise InvalidSnapshot(f"snapshot.{name}", what, f"{array.dtype} {array.shape}")
    return array


def _require_covariances(name: str, matrices: np.ndarray) -> None:
    """Refuses (..., n, n) that are no covariances.

    Raises:
        InvalidSnapshot: variances that are not positive or too large, or an eigenvalue below what rounding leaves.
    """
    variances = np.diagonal(matrices, axis1=-2, axis2=-1)
    positive = ((variances > 0) & (variances <= LARGEST_VARIANCE)).all()
    symmetric = np.abs(matrices - np.swapaxes(matrices, -2, -1)).max() <= ROUNDING * np.abs(matrices).max()
    values = np.linalg.eigvalsh(matrices) if positive and symmetric else np.full(1, -np.inf)
    if not (values[..., 0] >= -ROUNDING * values[..., -1]).all():
        raise InvalidSnapshot(f"snapshot.{name}", f"covariances up to {LARGEST_VARIANCE:g}", "another matrix")


def _rotation(model: np.ndarray, arrays: dict[str, np.ndarray]) -> np.ndarray:
    rotation = like(model, arrays, "rotation")
    if not (np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)) < ROUNDING).all():
        raise InvalidSnapshot("snapshot.rotation", "a rotation per vertex", "other matrices")
    return rotation


def _drift(model: Drift, arrays: dict[str, np.ndarray], values: list) -> Drift:
    covariance = like(model.covariance, arrays, "drift_covariance")
    _require_covariances("drift_covariance", covariance)
    speed2, stored2, hem2, *later = map(float, values)
    unseen_turn, turning = (*later, *[0.0] * (2 - len(later)))  # earlier snapshots lack one or both
    if not all(0.0 <= value <= LARGEST_NUMBER for value in (speed2, stored2, hem2, unseen_turn, abs(turning))):
        raise InvalidSnapshot("snapshot.drift", f"numbers from 0 to {LARGEST_NUMBER:g}", repr(values))
    missed = like(model.missed, arrays, "drift_missed") if "drift_missed" in arrays else model.missed  # not in earlier snapshots
    return Drift(covariance, speed2, stored2, hem2, unseen_turn, turning, missed=missed)


def _resting(tracker, arrays: dict[str, np.ndarray]) -> Resting | None:
    size, first = _size(arrays, "resting_size"), tracker._track.state.position
    if "resting_position" not in arrays:
        return rigidity.of_template(size, tracker._setup) if "resting_size" in arrays else None
    return rigidity.resting(like(first, arrays, "resting_position"), tracker._setup, size)


def _appearance(tracker, arrays: dict[str, np.ndarray]) -> Appearance | None:
    if not any(name.startswith("appearance_") for name in arrays):
        return None
    fresh = colour.start(tracker._setup.model, tracker.config.colour)
    found = {name: arrays[f"appearance_{name}"] for name in SEEN}
    for name, array in found.items():
        model, least = getattr(fresh, name), SEEN[name]
        finite = np.isfinite(array) | (name == "registered2")  # infinite where nothing was learned
        if array.shape != model.shape or array.dtype != model.dtype or not (finite & (array >= least)).all():
            what = f"finite {model.dtype} of shape {model.shape}"
            raise InvalidSnapshot(f"snapshot.appearance_{name}", what, f"{array.dtype} {array.shape}")
    found["noise2"] = np.maximum(found["noise2"], colour.LEAST_NOISE2)
    return fresh._replace(**found)


def _palette(tracker, arrays: dict[str, np.ndarray]) -> Palette:
    of_vertices = (tracker._setup.model.mesh.n_vertices,)
    found = Palette(*(arrays[f"palette_{name}"] for name in Palette._fields))
    for name, shape in zip(Palette._fields, ((2, *CELLS), of_vertices, of_vertices), strict=True):
        array = getattr(found, name)
        if array.shape != shape or array.dtype != np.float32 or not (np.isfinite(array) & (array >= -ROUNDING)).all():
            what = f"float32 of shape {shape}, finite and 0 or more"
            raise InvalidSnapshot(f"snapshot.palette_{name}", what, f"{array.dtype} {array.shape}")
    return Palette(*(np.maximum(array, np.float32(0.0)) for array in found))  # earlier versions wrote -1e-16 for 0


def _anchor(tracker, arrays: dict[str, np.ndarray]) -> BodyAnchor:
    pose = like(tracker.body.vertices, arrays, "worn_pose")
    position = like(tracker._track.state.position, arrays, "worn_position")
    fresh = body_anchor.start(tracker._setup, pose, position)
    learned = {name: like(getattr(fresh, name), arrays, f"worn_{name}") for name in LEARNED}
    if fresh.across is not None:  # of earlier snapshots the guess
        known = "worn_across" in arrays
        learned["across"] = like(fresh.across, arrays, "worn_across") if known else learned["seen"] * fresh.slip
    if any((values < 0).any() for values in learned.values()):
        raise InvalidSnapshot("snapshot.worn", "shares and squares that are not negative", "others")
    return fresh._replace(**learned)


def _strain2(variance) -> float:
    if isinstance(variance, bool) or not isinstance(variance, int | float) or not 0 <= variance <= LARGEST_NUMBER:
        raise InvalidSnapshot("snapshot.elasticity", f"a square up to {LARGEST_NUMBER:g}", repr(variance))
    return float(variance)


def _size(arrays: dict[str, np.ndarray], name: str) -> np.ndarray:
    """(3, 3); zeros in earlier snapshots."""
    if name not in arrays:
        return np.zeros((3, 3))
    size = like(np.zeros((3, 3)), arrays, name)
    if np.abs(size).max() > LARGEST or (size != size.T).any():
        raise InvalidSnapshot(f"snapshot.{name}", f"a symmetric matrix of numbers up to {LARGEST:g}", "another one")
    return size


def _health(values: dict) -> Health:
    health = Health(**values)
    pairs = zip(health[1:], Health()[1:], strict=True)
    numbers = all(_like_number(*pair) for pair in pairs)
    if health.state not in get_args(TrackerState) or not numbers or health.physics_lambda < 1:
        raise InvalidSnapshot("snapshot.health", "a state, and numbers that are not negative", str(values))
    if max(health.reliability, health.unexplained, health.least_unexplained) > 1:
        raise InvalidSnapshot("snapshot.health", "a reliability and shares up to 1", str(values))
    return health


def _like_number(value, model: bool | int | float) -> bool:
    """Whether a value is a flag, a count or a number that is not negative, as ``model`` is."""
    kinds, most = (int | float, MAX_TIME) if isinstance(model, float) else (int, MOST)
    return isinstance(value, bool) == isinstance(model, bool) and isinstance(value, kinds) and 0 <= value <= most


def _view(values: dict) -> View:
    view = View(**values | {"side": tuple(values["side"])})
    length = math.hypot(*view.side)
    numbers = all(_like_number(*pair) for pair in zip((*view[:2], *view[3:]), (False, 0.0, 0.0, 0), strict=True))
    if not numbers or len(view.side) != 3 or not (length == 0 or abs(length - 1) < 1e-6):
        raise InvalidSnapshot("snapshot.view", "a share, a unit vector or 0, and a count", str(values))
    return view


def _sensors(arrays: dict[str, np.ndarray], values: list | None, last: float | None) -> Sensors | None:
    if values is None:
        return None
    time, wait = _time(values[0]), values[1]
    if time is not None and (last is None or time > last):
        raise InvalidSnapshot("snapshot.sensors", "a time that is not after the last frame's", repr(time))
    count = len(arrays["sensors_origin"])
    if not 1 <= count <= MAX_SENSORS or not _like_number(wait, 0):
        raise InvalidSnapshot("snapshot.sensors", f"1 to {MAX_SENSORS} sensors, and a count", f"{count} sensors, {wait!r}")
    fresh = sensor_poses.unknown(np.zeros((count, 3)))
    found = {name: like(getattr(fresh, name), arrays, f"sensors_{name}", MOST_INFORMATION) for name in FOUND}
    if np.linalg.norm(found["shift"], axis=1).max() > 1.001 * sensor_poses.FARTHEST:
        raise InvalidSnapshot("snapshot.sensors_shift", f"at most {sensor_poses.FARTHEST:g} m", "more")
    if np.linalg.eigvalsh(found["information"])[0] < -1e-6 * np.abs(found["information"]).max():
        raise InvalidSnapshot("snapshot.sensors_information", "a matrix with no negative eigenvalue", "another one")
    return Sensors(**found, time=time, wait=wait)


def _signs(values: dict) -> dict[str, int]:
    if not values.keys() <= set(get_args(WarningCode)) or not all(_like_number(count, 0) for count in values.values()):
        raise InvalidSnapshot("snapshot.signs", "a count of frames by code", str(values))
    return values


def _costs(values: list | None) -> Costs | None:
    if values is None:
        return None
    costs = Costs(*(Rate(*rate) for rate in values[:-1]), values[-1])
    numbers = [(value, model) for rate in costs[:-1] for value, model in zip(rate, Rate(1.0, 1.0), strict=True)]
    if not all(_like_number(*pair) for pair in [*numbers, (costs.overruns, 1.0)]) or min(rate.mean for rate in costs[:-1]) <= 0:
        raise InvalidSnapshot("snapshot.costs", "pairs of positive seconds, and a count", str(values))
    return costs


def _time(value) -> float | None:
    number = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= MAX_TIME
    if value is not None and not number:
        raise InvalidSnapshot("snapshot.time", f"seconds within {MAX_TIME:g}, or null", repr(value))
    return value


def pack(numbers: dict, arrays: dict[str, np.ndarray], level: int = 1) -> bytes:
    """Sealed bytes of a compressed archive of the arrays and the JSON of the numbers."""
    stream = io.BytesIO()
    text = np.frombuffer(json.dumps(numbers).encode(), np.uint8)
    np.savez(stream, numbers=text, **arrays)
    return sealed(zlib.compress(stream.getvalue(), level))


def sealed(body: bytes, version: int = VERSION) -> bytes:
    """Magic, version, CRC-32 of the version and of what follows, then that."""
    return MAGIC + version.to_bytes(4, "little") + _checksum(version, body).to_bytes(4, "little") + body


def unpack(data: bytes) -> tuple[dict, dict[str, np.ndarray]]:
    """What :func:`pack` was given.

    Raises:
        InvalidSnapshot: not a snapshot, of another version, or damaged.
    """
    if not isinstance(data, bytes | bytearray | memoryview):
        raise InvalidSnapshot("snapshot", "bytes of a ddakf tracker", type(data).__name__)
    data = bytes(data)
    if len(data) < 16 or data[:8] != MAGIC:
        raise InvalidSnapshot("snapshot", "bytes of a ddakf tracker", f"{len(data)} other bytes")
    version = int.from_bytes(data[8:12], "little")
    if version not in READ:
        raise InvalidSnapshot("snapshot.version", f"{READ[0]} to {VERSION}", str(version))
    if _checksum(version, data[16:]) != int.from_bytes(data[12:16], "little"):
        raise InvalidSnapshot("snapshot", "intact bytes", "a wrong checksum")
    try:
        reader = zlib.decompressobj()
        body = reader.decompress(data[16:], MAX_BYTES)
        if reader.unconsumed_tail:
            raise InvalidSnapshot("snapshot", f"at most {MAX_BYTES} bytes when unpacked", "more")
        arrays = _members(body)
        if version < 16 and "worn_squares" in arrays:
            arrays["worn_squares"] = np.ascontiguousarray(arrays["worn_squares"][:, 0])
        return _present(json.loads(arrays.pop("numbers").tobytes()), version), arrays
    except InvalidSnapshot:
        raise
    except (zlib.error, zipfile.BadZipFile, ValueError, LookupError, EOFError, OSError, RuntimeError, struct.error) as error:
        raise InvalidSnapshot("snapshot", "an archive of arrays", str(error) or type(error).__name__) from None


def _checksum(version: int, body: bytes) -> int:
    """Of the version too, so that none is taken for another; before 13 of the body alone."""
    return zlib.crc32(body, zlib.crc32(version.to_bytes(4, "little")) if version >= 13 else 0)


def _present(numbers: dict, version: int) -> dict:
    """The numbers without what only earlier versions have."""
    if version >= VERSION or not isinstance(numbers, dict):
        return numbers
    if isinstance(config := numbers.get("config"), dict):
        laws = ("frame_error", "vertex_error", "normal_error", "tangential_error")  # fitted together, last for 24
        for law in laws if version < 24 else ():
            config.pop(law, None)
        for part, field in itertools.chain(*(fields for end, fields in DROPPED.items() if version < end)):
            if isinstance(config.get(part), dict):
                config[part].pop(field, None)
        for (part, field), (new_part, new_field) in MOVED.items():
            old, new = config.get(part), config.setdefault(new_part, {})
            if isinstance(old, dict) and isinstance(new, dict) and field in old:
                new[new_field] = old.pop(field)
    if isinstance(health := numbers.get("health"), dict):
        health.pop("least_strain", None)
    return numbers


def _members(body: bytes) -> dict[str, np.ndarray]:
    """The arrays of an uncompressed archive, each as long as its own header says; numpy would take memory for what that declares.

    Raises:
        InvalidSnapshot, ValueError, OSError, BadZipFile: it is none.
    """
    with zipfile.ZipFile(io.BytesIO(body)) as archive:
        members = archive.infolist()
        size = sum(member.file_size for member in members)
        if size > len(body) or any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise InvalidSnapshot("snapshot", "an archive that is not compressed", f"one that grows to {size} bytes")
        return {member.filename.removesuffix(".npy"): _array(archive.read(member)) for member in members}


def _array(data: bytes) -> np.ndarray:
    stream = io.BytesIO(data)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError("an array of another version than 1.0")
    try:
        shape, column_major, dtype = np.lib.format.read_array_header_1_0(stream)
    except Exception as error:  # it evaluates a literal of Python, which fails in many ways
        raise ValueError(f"an array without a header ({error})") from error
    held = len(data) - stream.tell()
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != held or min(shape, default=0) < 0:
        raise ValueError(f"an array of {dtype} and shape {shape} in {held} bytes")
    array = np.frombuffer(data, dtype, offset=stream.tell())
    return array.reshape(shape, order="F" if column_major else "C").copy()
