"""Textures of simulated garments: colours fixed to the cloth, shaded by a light and noisy like a camera's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ddakf.errors import InvalidArgument
from ddakf.files.sequence import Sequence
from ddakf.kernels.normals import vertex_normals

Pattern = Literal["plain", "stripes", "checks", "print"]

GAMMA = 1.0 / 2.2  # from light to values of a camera
LIGHT = np.array([0.5, 0.7, 0.5]) / np.linalg.norm([0.5, 0.7, 0.5])  # direction toward it
SKIN = np.array([0.75, 0.5, 0.4])
EDGE = 0.003  # m, over which a pixel blurs the edge of a stripe
CLOTH = np.array([0.12, 0.2, 0.45]), np.array([0.85, 0.85, 0.8])  # of stripes and checks; the first one of plain cloth
INKS = np.array([[0.8, 0.75, 0.65], [0.6, 0.12, 0.1], [0.1, 0.3, 0.25], [0.15, 0.15, 0.2]])  # of a print
BLOBS = 24  # waves of a print
SHARP = 12.0  # of the edges of its blots


@dataclass(frozen=True)
class Texture:
    """A texture and how a camera sees it.

    Attributes:
        pattern: ``plain``: one colour; ``stripes``: around the garment; ``checks``: in three directions; ``print``: blots of four
            inks, no two alike.
        period: of stripes and checks, and the typical length of a print, metres.
        ambient: share of the light that comes from all sides; the rest comes from above and shades (Lambert).
        exposure: standard deviation of the logarithm of a frame's exposure.
        noise: standard deviation of a value of 0 to 255.
        seed: of a print.
    """

    pattern: Pattern = "print"
    period: float = 0.06
    ambient: float = 0.5
    exposure: float = 0.05
    noise: float = 3.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.pattern not in get_args(Pattern):
            raise InvalidArgument("pattern", f"one of {', '.join(get_args(Pattern))}", repr(self.pattern))
        if not self.period > 0:
            raise InvalidArgument("period", "metres above 0", str(self.period))
        if not 0 <= self.ambient <= 1:
            raise InvalidArgument("ambient", "a share in [0, 1]", str(self.ambient))
        for name in ("exposure", "noise"):
            if not getattr(self, name) >= 0:
                raise InvalidArgument(name, "0 or more", str(getattr(self, name)))

    def albedo(self, places: np.ndarray) -> np.ndarray:
        """(N, 3) in [0, 1], at (N, 3) places on the garment at rest, metres."""
        dark, light = CLOTH
        match self.pattern:
            case "plain":
                return np.tile(dark, (len(places), 1))
            case "stripes":
                share = self._stripe(places[:, 1])
            case "checks":
                share = np.mean([self._stripe(places[:, a]) for a in range(3)], axis=0)
            case "print":
                return self._print(places)
        return dark + share[:, None] * (light - dark)

    def _stripe(self, along: np.ndarray) -> np.ndarray:
        """(N,) 0 to 1, at (N,) metres across the stripes."""
        wave = np.sin(2 * np.pi * along / self.period) * self.period / (2 * np.pi)  # about the distance from the edge
        return 0.5 + 0.5 * np.tanh(wave / EDGE)

    def _print(self, places: np.ndarray) -> np.ndarray:
        rng = np.random.default_rng([self.seed, 7])
        height = np.zeros((len(INKS), len(places)))
        for ink in range(len(INKS)):
            direction = rng.normal(size=(BLOBS, 3))
            direction /= np.linalg.norm(direction, axis=1)[:, None]
            length, phase = self.period * rng.uniform(0.6, 1.6, BLOBS), rng.uniform(0, 2 * np.pi, BLOBS)
            height[ink] = np.cos(2 * np.pi * places @ (direction / length[:, None]).T + phase).sum(axis=1)
        share = np.exp(SHARP * (height - height.max(axis=0)) / np.sqrt(BLOBS))
        return (share / share.sum(axis=0)).T @ INKS

    def colors(self, sequence: Sequence, frame: int, seen: tuple[np.ndarray, np.ndarray], rng: np.random.Generator) -> np.ndarray:
        """(N, 3) uint8, red, green and blue of points on the scene of a frame.

        Args:
            sequence: garment and body.
            frame: its number.
            seen: (N, 3) points, metres, and (N,) their faces, those of the garment before those of the body.
            rng: of the camera's noise.
        """
        points, face = np.asarray(seen[0], np.float64), seen[1]
        cloth, light = face < len(sequence.garment_faces), np.empty((len(points), 3))
        corner, share = _places(sequence.garment_vertices[frame], sequence.garment_faces[face[cloth]], points[cloth])
        light[cloth] = self.albedo(_blend(sequence.template, corner, share))
        light[cloth] *= self._shade(sequence.garment_vertices[frame], sequence.garment_faces, corner, share)
        if not cloth.all():
            number = face[~cloth] - len(sequence.garment_faces)
            corner, share = _places(sequence.body_vertices[frame], sequence.body_faces[number], points[~cloth])
            light[~cloth] = SKIN * self._shade(sequence.body_vertices[frame], sequence.body_faces, corner, share)
        exposed = light * np.exp(self.exposure * rng.normal())
        value = 255 * np.clip(exposed, 0, None) ** GAMMA + self.noise * rng.normal(size=light.shape)
        return np.clip(np.rint(value), 0, 255).astype(np.uint8)

    def _shade(self, vertices: np.ndarray, faces: np.ndarray, corner: np.ndarray, share: np.ndarray) -> np.ndarray:
        """(N, 1) light that reaches places on a mesh, Lambert's law."""
        vertices, normal = np.asarray(vertices, np.float64), np.empty((len(vertices), 3))
        vertex_normals(vertices, faces.astype(np.int32), normal)
        here = _blend(normal, corner, share)
        here /= np.maximum(np.linalg.norm(here, axis=1), 1e-12)[:, None]
        return (self.ambient + (1.0 - self.ambient) * np.maximum(here @ LIGHT, 0.0))[:, None]


def _places(vertices: np.ndarray, corner: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) corners and (N, 3) barycentric coordinates of points on faces."""
    a, b, c = (np.asarray(vertices, np.float64)[corner[:, k]] for k in range(3))
    u, v, w = b - a, c - a, points - a
    uu, uv, vv = (np.einsum("na,na->n", *pair) for pair in ((u, u), (u, v), (v, v)))
    wu, wv = np.einsum("na,na->n", w, u), np.einsum("na,na->n", w, v)
    area = np.maximum(uu * vv - uv * uv, 1e-30)
    s, t = (vv * wu - uv * wv) / area, (uu * wv - uv * wu) / area
    return corner, np.clip(np.column_stack([1.0 - s - t, s, t]), 0.0, 1.0)


def _blend(values: np.ndarray, corner: np.ndarray, share: np.ndarray) -> np.ndarray:
    return np.einsum("nk,nka->na", share, np.asarray(values, np.float64)[corner])
