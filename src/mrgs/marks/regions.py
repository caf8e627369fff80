"""Parts of a surface with an emissivity of their own, and what that does to a picture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float

from mrgs.errors import ConfigError
from mrgs.marks.emissivity import CaptureSettings, SurfaceSettings
from mrgs.marks.mark import Mark, Marks
from mrgs.marks.surface import (
    SeenSurface,
    fitted_plane,
    measuring_camera,
    outline_mask,
    pixels_of,
    rays_of,
    see,
    seen_depth,
)
from mrgs.runs.baked import BakedModel
from mrgs.scene import THERMAL, Camera, Rendering, TemperatureRange
from mrgs.scene.depth_map import SurfaceRenderer
from mrgs.system.memory import row_chunks
from mrgs.system.wording import Message

Points: TypeAlias = Float[np.ndarray, "n 3"]
Vector: TypeAlias = Float[np.ndarray, "3"]

REGION_DEPTH = 0.08
"""A point belongs to a region if its distance from the eye differs from that of the surface by less
than this share: more than the depths of a model differ from view to view."""

FLAT, FLAT_PERCENT = 0.02, 75
"""A region is flat if ``FLAT_PERCENT`` of its depths are within the share ``FLAT`` of a plane's."""

MOST_FITTED = 4_000
"""Pixels of a region that its plane is found by."""


class RegionPlane(NamedTuple):
    """The points of the world whose product with ``normal``, of any length, is ``offset``."""

    normal: Vector
    offset: float

    @classmethod
    def through(cls, surface: SeenSurface, inside: Bool[np.ndarray, "h w"]) -> RegionPlane | None:
        """The plane of the surface in some pixels; None where it is not flat, or not seen."""
        rows, columns = np.nonzero(inside & np.isfinite(surface.depth))
        step = -(-len(rows) // MOST_FITTED)
        if not step:
            return None
        rows, columns = rows[::step], columns[::step]
        camera, depth = surface.camera, surface.depth[rows, columns]
        rays = rays_of(camera, rows, columns)
        plane = fitted_plane(rays, depth)
        if np.percentile(np.abs(depth * (rays @ plane) - 1), FLAT_PERCENT) > FLAT:
            return None
        rotation, shift = camera.viewmat[:3, :3].numpy(), camera.viewmat[:3, 3].numpy()
        return cls(plane @ rotation, float(1 - plane @ shift))

    def meets(self, points: Points, eye: Vector) -> Points:
        """Points moved along their rays from an eye onto the plane; points that would move by more
        than ``REGION_DEPTH`` of their distance stay."""
        rays = points - eye
        with np.errstate(divide="ignore", invalid="ignore"):
            times = (self.offset - eye @ self.normal) / (rays @ self.normal)
            near = np.abs(times - 1) < REGION_DEPTH
        found: Points = eye + np.where(near, times, 1.0)[:, None] * rays
        return found


class SettingsShare(NamedTuple):
    """Settings of a share of a surface, over 0 to 1; None for the photos' settings."""

    settings: SurfaceSettings | None
    share: float


@dataclass(frozen=True, eq=False)
class SurfaceRegion:
    """The surface within the outline of a mark, as seen from the mark's eye: the pixels within the
    outline, and its plane, None where it is not flat."""

    settings: SurfaceSettings
    surface: SeenSurface
    inside: Bool[np.ndarray, "h w"]
    plane: RegionPlane | None

    def contains(self, points: Points, eye: Vector | None = None) -> Bool[np.ndarray, " n"]:
        """Which points of the world are on it, [N]; not NaN. ``eye`` sees them, if they are pixels
        of an image: their depths differ from pixel to pixel, which from the side would make the
        edge of a flat region ragged."""
        if eye is not None and self.plane is not None:
            points = self.plane.meets(points, eye)
        camera = self.surface.camera
        at = pixels_of(camera, points)
        _, depth = camera.project(torch.from_numpy(np.asarray(points, dtype=np.float64)))
        seen = self.surface.depth[at.rows, at.columns]
        with np.errstate(invalid="ignore"):
            near = np.abs(seen - depth.numpy()) < REGION_DEPTH * seen
        inside: Bool[np.ndarray, " n"] = at.inside & self.inside[at.rows, at.columns] & near
        return inside


class Regions:
    """All regions of a model with settings of their own, from marks with settings; where two
    overlap, the later one counts. Without known °C the list is empty. ``problems`` has a sentence
    for each mark that cannot be a region, by its name."""

    def __init__(
        self,
        marks: Marks,
        render: SurfaceRenderer,
        temperature: TemperatureRange | None,
        capture: CaptureSettings,
    ) -> None:
        self._render = render
        self._temperature = temperature
        self.capture = capture
        self.problems: dict[str, str] = {}
        self._regions: list[SurfaceRegion] = []
        for mark in marks.marks:
            if mark.has_settings:
                try:
                    self._regions.append(self._region(mark))
                except ConfigError as error:
                    self.problems[mark.name] = error.message

    def _region(self, mark: Mark) -> SurfaceRegion:
        if self._temperature is None:
            raise ConfigError(
                Message("{name}: without °C there is no emissivity to correct", name=mark.name)
            )
        settings, camera = self.capture.of_mark(mark), measuring_camera(mark)
        surface, inside = see(self._render, camera), outline_mask(camera, mark.points)
        return SurfaceRegion(settings, surface, inside, RegionPlane.through(surface, inside))

    def __bool__(self) -> bool:
        return bool(self._regions)

    def __iter__(self) -> Iterator[SurfaceRegion]:
        return iter(self._regions)

    def applied_to(self, rendering: Rendering, camera: Camera) -> Rendering:
        """A rendering with the temperatures of the regions corrected; the same without regions."""
        if not self or THERMAL not in rendering:
            return rendering
        surface = SeenSurface(camera, rendering, seen_depth(rendering))
        positions = surface.positions.reshape(-1, 3)
        image = rendering[THERMAL].image
        eye, values = camera.position.double().numpy(), image.cpu().double().numpy().reshape(-1)
        values = self.corrected_at(positions, values, self._temperature, eye)
        return rendering.with_images(
            {THERMAL: torch.from_numpy(values).to(image).view(image.shape)}
        )

    def render(self, camera: Camera) -> Rendering:
        """The model from a camera, with the temperatures of the regions corrected."""
        return self.applied_to(self._render(camera), camera)

    def shares_at(self, points: Points) -> list[SettingsShare]:
        """The settings of some points with their shares, the largest first."""
        shares = [SettingsShare(each, float(held.mean())) for each, held in self.parts(points)]
        photos = SettingsShare(None, 1.0 - sum(each.share for each in shares))
        return sorted([photos, *shares], key=lambda each: each.share, reverse=True)

    def parts(
        self, points: Float[np.ndarray, "*shape 3"], eye: Vector | None = None
    ) -> Iterator[tuple[SurfaceSettings, Bool[np.ndarray, "*shape"]]]:
        """The settings of each region, and which of some points on surfaces are its own; see
        ``SurfaceRegion.contains``."""
        flat = points.reshape(-1, 3)
        owner = np.full(len(flat), -1, np.int16)
        for rows in row_chunks(len(flat)):
            for number, region in enumerate(self._regions):
                owner[rows][region.contains(flat[rows], eye)] = number
        for number, region in enumerate(self._regions):
            yield region.settings, (owner == number).reshape(points.shape[:-1])

    def of_splats(self, baked: BakedModel) -> BakedModel:
        """A model of splats whose temperatures are corrected one by one. Their blend is off by
        degrees where splats are large beside the region, which those outside reach into
        uncorrected; ``applied_to`` and ``corrected_at`` correct the blend."""
        if not self:
            return baked
        means, values = baked.means.double().numpy(), baked.temperatures.double().numpy()
        values = self.corrected_at(means, values, self._temperature)
        return replace(baked, temperatures=torch.from_numpy(values).to(baked.temperatures))

    def corrected_at(
        self,
        points: Points,
        values: Float[np.ndarray, " n"],
        scale: TemperatureRange | None = None,
        eye: Vector | None = None,
    ) -> Float[np.ndarray, " n"]:
        """Temperatures of points (°C, or normalised by ``scale``), corrected where a region has
        them, see ``SurfaceRegion.contains``, and there is such a temperature."""
        corrected = values.copy()
        for settings, held in self.parts(points, eye):
            found = values[held].astype(np.float64)
            found = found if scale is None else scale.to_celsius(found)
            found = self.capture.corrected(found, settings)
            found = found if scale is None else scale.from_celsius(found)
            corrected[held] = np.where(np.isfinite(found), found, values[held])
        return corrected
