"""Removing the noise of path tracing from a photo, guided by what its pixels show.

The light on the surfaces (the photo over the surfaces' colour) is smoothed by an edge-avoiding
à-trous filter (Dammertz et al. 2010): 5 × 5 neighbours at growing distances, weighted by whether
they lie on the same plane, face the same way, and differ by no more than the noise that several
pictures of the same view show. Textures are divided out before and multiplied afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit
from scipy.ndimage import uniform_filter

from mrgs.scene import Camera
from mrgs_synth.colors import from_srgb
from mrgs_synth.hits import Triangles, first_hits, ray_directions
from mrgs_synth.radiometry import facing_normals
from mrgs_synth.stage import Solid

STEPS = (1, 2, 4)
ALBEDO_RAYS_PER_SIDE = 3
PLANE_SHARE = 0.004
"""Pixels lie on one plane if they stray from it by less than this share of the distance."""
DARKEST = 0.015
"""Surfaces count as no darker, so that black ones do not amplify what they reflect."""


@dataclass(frozen=True, eq=False)
class Guides:
    """What the pixels of a view show.

    Attributes:
        albedo: mean linear colour of the surfaces' textures within each pixel, [H, W, 3].
        normals: at the pixels' centres, towards the camera; 0 where there is no surface.
        positions: there, metres.
        distance: there, from the camera, metres.
    """

    albedo: Float[np.ndarray, "h w 3"]
    normals: Float[np.ndarray, "h w 3"]
    positions: Float[np.ndarray, "h w 3"]
    distance: Float[np.ndarray, "h w"]


class Guide:
    """Finds what views of some solids show."""

    def __init__(self, solids: Sequence[Solid]) -> None:
        self._triangles = Triangles.of(solids)
        self._textures = [from_srgb(solid.material.texture) for solid in solids]

    def of(self, camera: Camera) -> Guides:
        """The guides of one view."""
        hits, directions = first_hits(camera, self._triangles), ray_directions(camera)
        seen = hits.solid >= 0
        normals = np.zeros(hits.points.shape)
        normals[seen] = facing_normals(
            self._triangles, hits.triangle[seen], hits.points[seen], directions[seen]
        )
        distance = np.linalg.norm(hits.points - camera.position.numpy(), axis=-1)
        return Guides(self._albedo(camera), normals, hits.points, distance)

    def _albedo(self, camera: Camera) -> Float[np.ndarray, "h w 3"]:
        side = ALBEDO_RAYS_PER_SIDE
        hits = first_hits(
            camera.resized(side * camera.width, side * camera.height), self._triangles
        )
        seen = hits.solid >= 0
        triangle = hits.triangle[seen]
        weights = self._triangles.weights(triangle, hits.points[seen])
        uv = (weights[:, :, None] * self._triangles.uv[triangle]).sum(axis=1)
        colors, of_hit = np.zeros((len(uv), 3)), hits.solid[seen]
        for index, texture in enumerate(self._textures):
            here = of_hit == index
            if here.any():
                colors[here] = _looked_up(texture, uv[here])
        albedo = np.zeros((*hits.solid.shape, 3))
        albedo[seen] = colors
        return albedo.reshape(camera.height, side, camera.width, side, 3).mean(axis=(1, 3))


def _looked_up(
    texture: Float[np.ndarray, "h w 3"], uv: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 3"]:
    """Bilinear values of a texture that repeats; row 0 is its upper edge, v = 1."""
    height, width = texture.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1.0 - uv[:, 1]) * height - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    a, b = (x - left)[:, None], (y - top)[:, None]
    rows, columns = (top % height, (top + 1) % height), (left % width, (left + 1) % width)
    upper = (1.0 - a) * texture[rows[0], columns[0]] + a * texture[rows[0], columns[1]]
    lower = (1.0 - a) * texture[rows[1], columns[0]] + a * texture[rows[1], columns[1]]
    return (1.0 - b) * upper + b * lower


def denoised(shots: Float[np.ndarray, "n h w 3"], guides: Guides) -> Float[np.ndarray, "h w 3"]:
    """The mean of several pictures of one view (radiance, with independent noise) without most of
    its noise."""
    surface = guides.distance > 0.0
    surface &= np.linalg.norm(guides.normals, axis=-1) > 0.5
    base = np.where(surface[..., None], np.maximum(guides.albedo, DARKEST), 1.0)
    noise = (shots / base).mean(axis=-1).var(axis=0, ddof=1) / len(shots)
    noise = np.sqrt(uniform_filter(noise, 5).clip(0.0))  # its running sums may fall below 0
    light = without_speckles(shots) / base
    reach = PLANE_SHARE * guides.distance
    for step in STEPS:
        light = _smoothed(light, noise, guides.normals, guides.positions, reach, surface, step)
        noise = 0.5 * noise
    return light * base


def without_speckles(
    shots: Float[np.ndarray, "n h w 3"], largest: float = 5.0
) -> Float[np.ndarray, "h w 3"]:
    """The mean of several pictures; where the brightest of them exceeds ``largest`` times the mean
    of the others, the mean of the others."""
    luminance = shots.sum(axis=-1)
    brightest = luminance.argmax(axis=0)[None, :, :, None]
    top = np.take_along_axis(shots, brightest, axis=0)[0]
    others = (shots.sum(axis=0) - top) / (len(shots) - 1)
    speckle = top.sum(axis=-1) > largest * others.sum(axis=-1)
    return np.where(speckle[..., None], others, shots.mean(axis=0))


@njit(cache=True)
@no_type_check
def _smoothed(light, noise, normals, positions, reach, surface, step) -> np.ndarray:
    """One level of the filter: neighbours at multiples of ``step`` pixels."""
    height, width, _ = light.shape
    kernel = (1.0, 4.0, 6.0, 4.0, 1.0)
    smooth = light.copy()
    for y in range(height):
        for x in range(width):
            if not surface[y, x]:
                continue
            own = light[y, x, 0] + light[y, x, 1] + light[y, x, 2]
            spread = 15.0 * noise[y, x] + 0.01 * own + 1e-9
            total = red = green = blue = 0.0
            for j in range(-2, 3):
                v = y + j * step
                if v < 0 or v >= height:
                    continue
                for i in range(-2, 3):
                    u = x + i * step
                    if u < 0 or u >= width or not surface[v, u]:
                        continue
                    cosine = offset = 0.0
                    for k in range(3):
                        cosine += normals[y, x, k] * normals[v, u, k]
                        offset += normals[y, x, k] * (positions[v, u, k] - positions[y, x, k])
                    if cosine < 0.9:
                        continue
                    theirs = light[v, u, 0] + light[v, u, 1] + light[v, u, 2]
                    weight = kernel[j + 2] * kernel[i + 2] * cosine**32
                    weight *= np.exp(-abs(offset) / reach[y, x] - abs(theirs - own) / spread)
                    total += weight
                    red += weight * light[v, u, 0]
                    green += weight * light[v, u, 1]
                    blue += weight * light[v, u, 2]
            if total > 0.0:
                smooth[y, x, 0], smooth[y, x, 1] = red / total, green / total
                smooth[y, x, 2] = blue / total
    return smooth
