"""What an ideal thermal camera reads: emission and one reflection, without an atmosphere between.

A surface of emissivity ε and temperature T emits the share ε of a black body's radiance and
reflects 1 − ε of what meets it (Kirchhoff's law for opaque grey bodies). With L, a black body's
radiance in the camera's band (``planck``), a camera that is set to an emissivity of 1 reads

    T_read = L⁻¹(ε L(T) + (1 − ε) L(T_reflected)).

A mirror reflects what lies in the direction r = d − 2 (d·n) n of the ray d at the normal n: the
first surface there, which emits with its own ε and scatters the mean of its surroundings, or what
lies beyond all surfaces. A rough surface reflects the mean of its surroundings
(``Stage.surroundings_c``) alone.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from mrgs.scene import Camera
from mrgs_synth.hits import Triangles, first_hits, ray_directions
from mrgs_synth.planck import band_radiance, temperature
from mrgs_synth.stage import Stage


def exact_temperature(
    camera: Camera, stage: Stage, triangles: Triangles, rays_per_side: int
) -> Float[np.ndarray, "h w"]:
    """What an ideal camera reads in each pixel, °C, from ``rays_per_side``² rays per pixel."""
    return pixel_readings(ray_readings(camera, stage, triangles, rays_per_side)[0], rays_per_side)


def ray_readings(
    camera: Camera, stage: Stage, triangles: Triangles, rays_per_side: int
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """What an ideal camera reads along each of ``rays_per_side``² rays per pixel, °C, and the
    z-depth there, metres; 0 where a ray meets nothing."""
    fine = camera.resized(camera.width * rays_per_side, camera.height * rays_per_side)
    hits = first_hits(fine, triangles)
    directions = ray_directions(fine)
    celsius = np.empty(hits.solid.shape)
    seen = hits.solid >= 0
    celsius[~seen] = stage.beyond_c(directions[~seen])
    celsius[seen] = surface_reading(
        stage, triangles, hits.triangle[seen], hits.points[seen], directions[seen]
    )
    return celsius, hits.depth_m


def pixel_readings(rays_c: Float[np.ndarray, "h w"], side: int) -> Float[np.ndarray, "h2 w2"]:
    """What pixels of ``side``² rays read, °C: the temperature of their mean radiance."""
    return temperature(block_means(band_radiance(rays_c), side))


def block_means(fine: Float[np.ndarray, "h w"], side: int) -> Float[np.ndarray, "h2 w2"]:
    """Means over squares of ``side``² values."""
    height, width = fine.shape
    mean: Float[np.ndarray, "h2 w2"] = fine.reshape(height // side, side, width // side, side).mean(
        axis=(1, 3)
    )
    return mean


def surface_reading(
    stage: Stage,
    triangles: Triangles,
    triangle: Int[np.ndarray, " n"],
    points: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, " n"]:
    """What an ideal camera reads of points of the surfaces, °C.

    Args:
        stage: the surfaces.
        triangles: their triangles.
        triangle: index of each point's triangle.
        points: in world coordinates, metres.
        directions: unit vectors from the camera to the points.
    """
    celsius, emissivity, mirror = _emission(stage, triangles, triangle, points)
    if mirror.any():
        chosen = triangle[mirror], points[mirror], directions[mirror]
        reflected = _mirrored(stage, triangles, *chosen)
        celsius[mirror] = mixed(celsius[mirror], emissivity[mirror], reflected)
    return celsius


def mixed(
    own_c: Float[np.ndarray, " n"],
    emissivity: Float[np.ndarray, " n"],
    reflected_c: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """The reading of a surface that reflects what reads ``reflected_c``, °C; exactly ``own_c`` at
    an emissivity of 1."""
    emitted, reflected = emissivity * band_radiance(own_c), band_radiance(reflected_c)
    reading = temperature(emitted + (1.0 - emissivity) * reflected)
    return np.where(emissivity == 1.0, own_c, reading)


def facing_normals(
    triangles: Triangles,
    triangle: Int[np.ndarray, " n"],
    points: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n 3"]:
    """Unit normals at points of triangles, interpolated between the corners, on the side that rays
    of these directions meet."""
    a, b, c = (triangles.corners[triangle, corner] for corner in range(3))
    flat = np.cross(b - a, c - a)
    weights = triangles.weights(triangle, points)
    smooth = (weights[:, :, None] * triangles.normals[triangle]).sum(axis=1)
    for normals in (smooth, flat):
        normals *= -np.sign((normals * directions).sum(axis=1, keepdims=True))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-300)
    turned_away = (smooth * flat).sum(axis=1) < 0.5
    smooth[turned_away] = flat[turned_away]
    return smooth


def _emission(
    stage: Stage,
    triangles: Triangles,
    triangle: Int[np.ndarray, " n"],
    points: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Readings of black and rough points and temperatures of mirrors in °C, emissivities, and which
    points are mirrors."""
    celsius = np.empty(len(points))
    of_point = triangles.solid[triangle]
    order = np.argsort(of_point, kind="stable")
    ends = np.searchsorted(of_point[order], np.arange(len(stage.solids)), side="right")
    for solid, here in zip(stage.solids, np.split(order, ends[:-1]), strict=True):
        if len(here):
            celsius[here] = solid.temperature_at(points[here])
    emissivity = np.array([solid.material.emissivity for solid in stage.solids])[of_point]
    mirror = np.array([solid.material.heat_mirror for solid in stage.solids])[of_point]
    mirror &= emissivity < 1.0
    rough = (emissivity < 1.0) & ~mirror
    if rough.any():
        scattered = _scattered(stage, triangles, triangle[rough])
        celsius[rough] = mixed(celsius[rough], emissivity[rough], scattered)
    return celsius, emissivity, mirror


def _scattered(
    stage: Stage, triangles: Triangles, triangle: Int[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """The mean of what triangles face, °C."""
    normals = triangles.normals.mean(axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-12)
    return stage.surroundings_c(normals)[triangle]


def _mirrored(
    stage: Stage,
    triangles: Triangles,
    triangle: Int[np.ndarray, " n"],
    points: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, " n"]:
    """What the mirror directions read, °C; a mirror found there scatters like a rough surface."""
    normals = facing_normals(triangles, triangle, points, directions)
    rays = directions - 2.0 * (directions * normals).sum(axis=1, keepdims=True) * normals
    start = points - 1e-6 * directions  # in front of the surface, whatever the rounding
    distance, met = triangles.tree.cast(start, rays)
    hit = met >= 0
    celsius = np.empty(len(points))
    celsius[~hit] = stage.beyond_c(rays[~hit])
    there = start[hit] + distance[hit, None] * rays[hit]
    own, emissivity, mirror = _emission(stage, triangles, met[hit], there)
    if mirror.any():
        scattered = _scattered(stage, triangles, met[hit][mirror])
        own[mirror] = mixed(own[mirror], emissivity[mirror], scattered)
    celsius[hit] = own
    return celsius
