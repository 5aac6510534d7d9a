"""Transfer: a track carried over to another working mesh of the same garment, fine or coarse, or to another configuration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ddakf.appearance import colour
from ddakf.body import body_anchor
from ddakf.garment.working_mesh import WorkingMesh
from ddakf.physics import rigidity
from ddakf.types import Appearance, BodyAnchor, BodyTrack, Drift, Palette, Resting, Setup, State, Track


@dataclass(frozen=True, eq=False, slots=True, weakref_slot=True)
class Discretised:
    """A garment on a working mesh, and what is constant while it is tracked. W working vertices, L patches."""

    working: WorkingMesh
    setup: Setup


def transferred(track: Track, source: Discretised, target: Discretised, kept: Resting | None = None) -> Track:
    """The track on the working mesh of ``target``; that of ``source`` has the same template and the same body.

    ``kept``, the target's former shape at rest, stays if it is the same one: a checkpoint goes to the finer mesh and back.

    Every value at a vertex goes through the template's vertices. Learned costs are those of the other mesh, and stay behind.
    """
    position = _moved(track.state.position, track.rotation, source, target)
    state = State(*(_resampled(values, source, target) for values in track.state))._replace(position=position)
    share = _patch_shares(source, target)
    return track._replace(
        state=state,
        rotation=rigidity.rotations(position, target.setup.model),
        drift=_drift(track.drift, share),
        body=_body(track.body, source, target),
        anchor=_anchor(track.anchor, share, source, target),
        costs=None,
        resting=_resting(track.resting, source, target, kept),
        appearance=_appearance(track.appearance, source, target),
        palette=_palette(track.palette, source, target),
        offset=None if track.offset is None else _resampled(track.offset, source, target),
    )


def reconfigured(track: Track, source: Setup, setup: Setup) -> Track:
    """The track with the rest shape, the body anchor's guesses and the texels of another configuration of the same mesh."""
    anchor, resting, appearance = track.anchor, track.resting, track.appearance
    if anchor is not None:
        new = body_anchor.start(setup, anchor.bound.pose, anchor.bound.position)
        across = anchor.seen * new.slip if anchor.across is None and new.across is not None else anchor.across
        across = None if new.across is None else across
        anchor = anchor._replace(bound=new.bound, guess=new.guess, slip=new.slip, held=new.held, across=across)
    if appearance is not None and source.config.colour.texel != setup.config.colour.texel:
        appearance = colour.resampled(appearance, np.arange(len(appearance.axis)), source, setup)
    return track._replace(anchor=anchor, resting=_again(resting, setup), appearance=appearance)


def _again(shape: Resting | None, setup: Setup) -> Resting | None:
    """The same rest shape with the constants of another configuration."""
    if shape is None:
        return None
    return rigidity.resting(shape.position, setup, shape.size, shape.given)


def _resampled(values: np.ndarray, source: Discretised, target: Discretised) -> np.ndarray:
    """(W', ...) values at the vertices of the target, of (W, ...) values of the source."""
    return target.working.sampled(source.working.spread(values))


def _moved(position: np.ndarray, rotation: np.ndarray, source: Discretised, target: Discretised) -> np.ndarray:
    """(W', 3) metres: the vertices of the target where the source's are at (W, 3), which its (W, 3, 3) rings have turned."""
    return target.working.sampled(source.working.carried(position, rotation))


def _patch_shares(source: Discretised, target: Discretised) -> np.ndarray:
    """(L', L) share of the vertices of each patch of the target that lie in each patch of the source."""
    template = source.setup.model.patch if source.working.places is None else _nearest(source, source.working.places.on_mesh)
    before = template if target.working.places is None else template[_nearest_corner(target.working.places.on_template)]
    after, shape = target.setup.model.patch, (len(target.setup.model.likeness), len(source.setup.model.likeness))
    count = np.bincount(np.ravel_multi_index((after, before), shape), minlength=shape[0] * shape[1]).reshape(shape)
    return count / count.sum(axis=1, keepdims=True)


def _nearest(garment: Discretised, places: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """(V,) the patch of the working vertex that is nearest to each vertex of the template."""
    return garment.setup.model.patch[_nearest_corner(places)]


def _nearest_corner(places: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """(N,) the corner with the largest barycentric coordinate, of (N, 3) corners and coordinates."""
    corner, share = places
    return corner[np.arange(len(corner)), share.argmax(axis=1)]


def _drift(drift: Drift, share: np.ndarray) -> Drift:
    """The drift of the target's patches: each one's error is the mean of those of the patches that it lies in."""
    mean = np.kron(share, np.eye(3)).astype(np.float32)
    return drift._replace(covariance=mean @ drift.covariance @ mean.T)


def _body(track: BodyTrack | None, source: Discretised, target: Discretised) -> BodyTrack | None:
    """The body; closest points are searched anew in the next frame."""
    if track is None:
        return None
    velocity, gap = (None if values is None else _resampled(values, source, target) for values in (track.velocity, track.gap))
    return track._replace(velocity=velocity, gap=gap, contacts=None)


def _resting(shape: Resting | None, source: Discretised, target: Discretised, kept: Resting | None) -> Resting | None:
    if shape is None:
        return None
    if kept is not None and (kept.source is shape.edge or shape.source is kept.edge):
        return rigidity.resize(kept, shape.size, target.setup)
    if not shape.given:
        return rigidity.of_template(shape.size, target.setup)._replace(source=shape.edge)
    position = _moved(shape.position, rigidity.rotations(shape.position, source.setup.model), source, target)
    return rigidity.resting(position, target.setup, shape.size)._replace(source=shape.edge)


def _palette(palette: Palette | None, source: Discretised, target: Discretised) -> Palette | None:
    if palette is None:
        return None
    alike, seen = (_resampled(counts, source, target) for counts in (palette.alike, palette.seen))  # -1e-16 for some of 0
    return Palette(palette.counts, *(np.maximum(counts, 0.0).astype(np.float32) for counts in (alike, seen)))


def _appearance(appearance: Appearance | None, source: Discretised, target: Discretised) -> Appearance | None:
    """The colours around the vertices of the target, each out of the patch of the source's vertex nearest to it."""
    if appearance is None:
        return None
    return colour.resampled(appearance, _owners(source, target), source.setup, target.setup)


def _owners(source: Discretised, target: Discretised) -> np.ndarray:
    """(W',) the vertex of the source that is nearest to each vertex of the target, through the template."""
    n, places = len(target.working.mesh.vertices), target.working.places
    template = np.arange(n) if places is None else _nearest_corner(places.on_template)
    return template if source.working.places is None else _nearest_corner(source.working.places.on_mesh)[template]


def _anchor(anchor: BodyAnchor | None, share: np.ndarray, source: Discretised, target: Discretised) -> BodyAnchor | None:
    """The place on the body where the garment was bound, and what was learned about it."""
    if anchor is None or not body_anchor.enabled(target.setup.config):
        return None
    position, pose = anchor.bound.position, anchor.bound.pose
    position = _moved(position, rigidity.rotations(position, source.setup.model), source, target)
    return body_anchor.start(target.setup, pose, position)._replace(
        seen=share @ anchor.seen,
        squares=share @ anchor.squares,
        across=None if anchor.across is None else share @ anchor.across,
        measured=_resampled(anchor.measured.astype(np.float64), source, target) > 0.5,
    )
