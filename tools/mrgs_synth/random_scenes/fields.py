"""Temperature fields of random scenes, and what conducts or warms within walls and floors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from mrgs_synth.conduction import Contact, Plate
from mrgs_synth.random_scenes.draw import Draw
from mrgs_synth.stage import TemperatureField

Spot = tuple[tuple[float, float, float], float, float]
"""Centre, standard deviation in metres, and rise in °C of a warm or cold place."""


def spotted(base: TemperatureField, spots: Sequence[Spot]) -> TemperatureField:
    """A field with Gaussian spots on it, in the same frame."""

    def field(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        celsius = base(points)
        for centre, size, rise in spots:
            squared = ((points - np.array(centre)) ** 2).sum(axis=1)
            celsius = celsius + rise * np.exp(-squared / (2.0 * size**2))
        return celsius

    return field


def graded(low_c: float, high_c: float, axis: int, low: float, high: float) -> TemperatureField:
    """From one temperature at coordinate ``low`` to another at ``high``; constant beyond."""
    span = high - low

    def field(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        share: Float[np.ndarray, " n"] = ((points[:, axis] - low) / span).clip(0.0, 1.0)
        return low_c + (high_c - low_c) * share

    return field


def hidden_in_wall(draw: Draw, plate: Plate, bridge_c: float, pipe_c: float) -> list[Contact]:
    """What a wall hides from the eye: gaps in its insulation, pipes, studs or anchors, a damp
    corner.

    Args:
        draw: chooses which of them, and where.
        plate: the wall; its first coordinate runs along it, its second upwards.
        bridge_c: temperature behind the insulation, °C.
        pipe_c: temperature of what flows in a pipe, °C.
    """
    x, z = plate.cell_centres()
    half, top = plate.length_m / 2, plate.width_m / 2
    contacts = []
    for _ in range(draw.whole(0, 3)):
        centre = draw.between(-0.9, 0.9) * half, draw.between(-0.9, 0.9) * top
        size = draw.between(0.2, 1.2), draw.between(0.2, 1.2)
        gap = (np.abs(x - centre[0]) < size[0] / 2) & (np.abs(z - centre[1]) < size[1] / 2)
        contacts.append(Contact(gap, bridge_c, draw.between(0.15, 0.6)))
    if draw.chance(0.6):
        contacts.append(Contact(_pipe(draw, x, z), pipe_c, draw.between(0.2, 0.6)))
    if draw.chance(0.35):
        pitch = draw.between(0.4, 0.8)
        studs = (x + half) % pitch < 0.06
        contacts.append(Contact(studs, bridge_c, draw.between(0.08, 0.25)))
    if draw.chance(0.35):
        pitch = draw.between(0.4, 0.7)
        anchors = np.hypot(x % pitch - pitch / 2, z % pitch - pitch / 2) < 0.06
        contacts.append(Contact(anchors, bridge_c, draw.between(0.15, 0.4)))
    if draw.chance(0.5):
        side = draw.one_of(-half, half)
        corner = np.abs(x - side) + (z + top) < draw.between(0.3, 1.0)
        damp_c = plate.ambient_c - draw.between(1.5, 4.0)
        contacts.append(Contact(corner, damp_c, draw.between(0.3, 1.0)))
    return contacts


def _pipe(
    draw: Draw, x: Float[np.ndarray, "rows columns"], z: Float[np.ndarray, "rows columns"]
) -> Bool[np.ndarray, "rows columns"]:
    """A pipe that rises, turns, and rises again."""
    first, second = (draw.between(0.8 * x.min(), 0.8 * x.max()) for _ in range(2))
    level, half = draw.between(0.6 * z.min(), 0.6 * z.max()), draw.between(0.03, 0.06)
    lower = (np.abs(x - first) < half) & (z < level)
    upper = (np.abs(x - second) < half) & (z > level)
    along = (np.abs(z - level) < half) & (x > min(first, second)) & (x < max(first, second))
    return lower | upper | along


def floor_heating(draw: Draw, plate: Plate, pipe_c: float) -> Contact:
    """A meandering pipe in a part of a floor."""
    x, y = plate.cell_centres()
    pitch, width = draw.between(0.18, 0.35), 0.05
    left, right = (
        draw.between(-0.45, -0.1) * plate.length_m,
        draw.between(0.1, 0.45) * plate.length_m,
    )
    turn = np.where(np.floor(x / pitch) % 2 == 0, 1.0, -1.0) * y > 0.43 * plate.width_m
    inside = (x > left) & (x < right) & (np.abs(y) < 0.45 * plate.width_m)
    cells = inside & ((x % pitch < width) | turn)
    return Contact(cells, pipe_c, draw.between(0.15, 0.4))


def touches(draw: Draw, plate: Plate, reach: tuple[float, float]) -> list[Contact]:
    """Traces of hands or feet: a few warm spots side by side, within ± ``reach`` metres."""
    x, y = plate.cell_centres()
    at = draw.between(-reach[0], reach[0]), draw.between(-reach[1], reach[1])
    contacts = []
    for step in range(draw.whole(2, 6)):
        spot = np.hypot(x - at[0] - 0.25 * step, y - at[1] - 0.12 * (step % 2)) < 0.07
        contacts.append(Contact(spot, 31.0, draw.between(0.2, 0.6)))
    return contacts
