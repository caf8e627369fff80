"""The world of a scene: its frame, its bounds, with the background beyond, and boxes in it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from mrgs.errors import ConfigError
from mrgs.scene.arrays import constant
from mrgs.scene.camera import Camera


class EarthPosition(NamedTuple):
    """A place on Earth, WGS 84: degrees north and east, metres above sea level or None."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None


@dataclass(frozen=True)
class WorldFrame:
    """The frame of a scene's coordinates.

    Attributes:
        metric: whether its unit is the metre.
        north: whether its axes point east, north and up.
        origin: of its coordinates on Earth; None if not known.
        residual_m: median distance of the cameras from their GPS positions, m; None without GPS.
        scale_error: standard uncertainty of its unit, as a share; None where that is not known.
        offset: of its origin in the local frame of a survey, m; None if they have one origin.
        control_m: RMS residual of check points, else control points, else lengths, m; None without.
    """

    metric: bool = False
    north: bool = False
    origin: EarthPosition | None = None
    residual_m: float | None = None
    scale_error: float | None = None
    offset: tuple[float, float, float] | None = None
    control_m: float | None = None

    @property
    def is_georeferenced(self) -> bool:
        """Whether every point of the scene has a known place on Earth."""
        return self.metric and self.north and self.origin is not None

    @property
    def length_unit(self) -> str:
        """``m``, or ``scene units``."""
        return "m" if self.metric else "scene units"


FARTHEST_SHARE = 0.99
"""Share of the start points, the nearest ones, inside the bounds: the others may be strays."""

TIMES_AS_FAR = 8.0
"""Distance of the background in radii of the scene: it must not shift against the scene as the
camera moves from photo to photo."""


class SceneBounds(NamedTuple):
    """A sphere around the cameras, of which it has the centre, and nearly all start points; in
    world coordinates and scene units."""

    centre: Float64[Tensor, "3"]
    radius: float

    @classmethod
    def of(cls, points: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> SceneBounds:
        """The bounds of start points [N, 3] and training cameras, at least one of each."""
        places = torch.stack([camera.position for camera in cameras])
        centre = places.mean(dim=0)
        distances = (points.double() - centre).norm(dim=1)
        farthest = distances.kthvalue(math.ceil(FARTHEST_SHARE * len(distances))).values
        return cls(centre, torch.maximum(farthest, (places - centre).norm(dim=1).max()).item())

    @property
    def background_distance(self) -> float:
        """Distance of the background from the centre, scene units."""
        return TIMES_AS_FAR * self.radius

    @property
    def background_begins(self) -> float:
        """Distance from the centre between the scene and the background, scene units."""
        return (self.background_distance + self.radius) / 2

    def is_background(self, points: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """Whether points of the world, [..., 3], are nearer to the background than to the scene;
        NaN does not."""
        centre = constant(tuple(self.centre.tolist()), points)
        return (points - centre).norm(dim=-1) > self.background_begins

    def without_background(
        self, camera: Camera, depth: Float[Tensor, "h w"]
    ) -> Float[Tensor, "h w"]:
        """A camera's z-depths in scene units, infinite where they are those of the background."""
        return torch.where(self.is_background(camera.unproject_image(depth)), torch.inf, depth)


Outlines: TypeAlias = Sequence[Sequence[tuple[float, float]]]

MOST_CORNERS, MOST_OUTLINES = 200, 20  # of an outline, and of a box


class Box(NamedTuple):
    """A box along the axes of the world from ``low`` to ``high``, both included; of it what is
    within all ``outlines``: polygons x, y, seen from above. Scene units."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    outlines: tuple[tuple[tuple[float, float], ...], ...] = ()

    @classmethod
    def between(
        cls, x0: float, y0: float, z0: float, x1: float, y1: float, z1: float,
        outlines: Outlines = (),
    ) -> Box:  # fmt: skip
        """The box between two opposite corners, within outlines whose corners are in their order:
        where sides cross, what lies between them is out where it is surrounded twice. ConfigError
        if the corners span no box, or there are too few or too many."""
        ends = [sorted(pair) for pair in ((x0, x1), (y0, y1), (z0, z1))]
        if not all(math.isfinite(low) and math.isfinite(high) and low < high for low, high in ends):
            raise ConfigError(
                f"crop: the box from {x0:g} {y0:g} {z0:g} to {x1:g} {y1:g} {z1:g} has no inside: "
                f"give two corners that differ in x, y and z; draw an outline from above"
            )
        fit = [3 <= len(o) <= MOST_CORNERS and math.isfinite(sum(map(sum, o))) for o in outlines]
        if len(fit) > MOST_OUTLINES or not all(fit):
            raise ConfigError(
                f"crop: give at most {MOST_OUTLINES} outlines of 3 to {MOST_CORNERS} corners x, y"
            )
        (x0, x1), (y0, y1), (z0, z1) = ends
        own = tuple(tuple((x, y) for x, y in outline) for outline in outlines)
        return cls((x0, y0, z0), (x1, y1, z1), own)

    @classmethod
    def around(cls, outlines: Outlines, z0: float, z1: float) -> Box:
        """What is within outlines, at least one, from height z0 to z1; see ``between``."""
        xs, ys = zip(*outlines[0], strict=True)
        return cls.between(min(xs), min(ys), z0, max(xs), max(ys), z1, outlines)

    def within(self, other: Box) -> Box:
        """What is in both boxes, which must meet."""
        x0, y0, z0 = map(max, self.low, other.low)
        x1, y1, z1 = map(min, self.high, other.high)
        outlines = dict.fromkeys((*self.outlines, *other.outlines))
        return Box((x0, y0, z0), (x1, y1, z1), tuple(outlines))

    def contains(self, points: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """Whether points of the world, [..., 3], are in it; NaN is not. On a side of an outline
        they may or may not be."""
        low, high = constant(self.low, points), constant(self.high, points)
        inside = ((points >= low) & (points <= high)).all(dim=-1)
        x, y = points[..., 0], points[..., 1]
        for outline in self.outlines:
            odd = torch.zeros_like(inside)  # the number of sides beyond which a point lies
            for (x0, y0), (x1, y1) in pairwise((*outline, outline[0])):
                if y0 != y1:
                    odd ^= ((y < y0) != (y < y1)) & (x < x0 + (y - y0) * ((x1 - x0) / (y1 - y0)))
            inside &= odd
        return inside

    def __str__(self) -> str:
        low, high = (" ".join(f"{number:.6g}" for number in end) for end in self[:2])
        corners = (f", within an outline of {len(outline)} corners" for outline in self.outlines)
        return f"{low} to {high}{''.join(corners)}"
