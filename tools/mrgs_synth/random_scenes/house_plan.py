"""The plan of a random house, and its roof."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrgs_synth.building import Opening, beam, rod
from mrgs_synth.random_scenes import finishes
from mrgs_synth.random_scenes.draw import Draw
from mrgs_synth.random_scenes.fields import graded, spotted
from mrgs_synth.random_scenes.weather import Weather
from mrgs_synth.shapes import Mesh, merge, quad
from mrgs_synth.stage import Material, Solid


@dataclass(frozen=True)
class Plan:
    """The house: its size in metres, storeys, and openings."""

    length: float
    depth: float
    storey: float
    storeys: int
    columns: int
    openings: tuple[Opening, ...]
    reveal: float

    @property
    def height(self) -> float:
        """Of the front wall."""
        return self.storey * self.storeys + 0.4


def drawn_plan(draw: Draw) -> Plan:
    """Windows in columns and storeys, of which some are missing; a door, perhaps a gate."""
    length, storeys, storey = draw.between(6.0, 13.0), draw.whole(1, 4), draw.between(2.6, 3.1)
    columns = max(2, min(draw.whole(2, 6), int(length / 1.7)))
    pitch, openings = length / columns, []
    entrance, gate = draw.whole(0, columns - 1), draw.chance(0.25)
    for column in range(columns):
        x = (column + 0.5) * pitch - length / 2
        wide = draw.between(0.45, 0.75) * min(pitch, 2.6)
        for level in range(storeys):
            floor_z = 0.35 + level * storey
            if level == 0 and column == entrance:
                door_wide = min(2.3, 0.85 * pitch) if gate else min(1.1, 0.8 * pitch)
                openings.append(Opening("door", x, 0.1, door_wide, 2.15))
            elif draw.chance(0.85):
                low = draw.one_of(0.8, 0.9, 0.3)
                tall = min(draw.between(1.1, 1.5), storey - low - 0.45)
                openings.append(Opening(f"window_{column}_{level}", x, floor_z + low, wide, tall))
    depth, reveal = draw.between(6.0, 9.0), draw.between(0.08, 0.22)
    return Plan(length, depth, storey, storeys, columns, tuple(openings), reveal)


def gabled_roof(draw: Draw, plan: Plan, weather: Weather) -> list[Solid]:
    """A roof with its ridge along the front, eaves, a gutter and a chimney."""
    half, out, back = plan.length / 2 + 0.3, draw.between(0.2, 0.7), plan.depth
    pitch = np.tan(np.radians(draw.between(18.0, 45.0)))
    eaves, ridge = plan.height - pitch * out, plan.height + pitch * back / 2
    front = np.array(
        [
            (-half, -out, eaves),
            (half, -out, eaves),
            (half, back / 2, ridge),
            (-half, back / 2, ridge),
        ]
    )
    mirrored = np.array([(x, back - y, z) for x, y, z in front])[[1, 0, 3, 2]]
    below = [face[[1, 0, 3, 2]] - [0.0, 0.0, 0.06] for face in (front, mirrored)]
    a, b = plan.length / 2, plan.height
    gables = [
        np.array([(a, 0.0, b), (a, back, b), (a, back / 2, ridge), (a, back / 2, ridge)]),
        np.array([(-a, back, b), (-a, 0.0, b), (-a, back / 2, ridge), (-a, back / 2, ridge)]),
    ]
    rise = draw.between(0.0, 0.25) * (weather.indoors_c - weather.air_c)
    spots = [
        ((draw.between(-a, a), draw.between(0.0, back / 2), b + 0.5), draw.between(0.3, 1.0), rise)
        for _ in range(draw.whole(0, 4))
    ]
    x, y = draw.between(-0.8, 0.8) * a, draw.between(0.3, 0.5) * back
    chimney = beam(x - 0.3, x + 0.3, y - 0.3, y + 0.3, plan.height, ridge + draw.between(0.5, 1.2))
    smoke = draw.one_of(0.0, 6.0, 18.0)
    return [
        Solid(
            "roof",
            merge([quad(front), quad(mirrored)]),
            Material(finishes.clay(draw, 240, 480)),
            spotted(weather.facing(1.0), spots),
        ),
        Solid(
            "eaves",
            merge([quad(face) for face in below]),
            finishes.wooden(draw),
            weather.facing(0.1),
        ),
        Solid(
            "gables",
            merge([quad(face) for face in gables]),
            finishes.matte(draw),
            weather.facing(0.4),
        ),
        Solid(
            "chimney",
            chimney,
            finishes.matte(draw, (150, 84, 64)),
            graded(weather.air_c + 0.3 * smoke, weather.air_c + smoke, 2, plan.height, ridge),
        ),
        Solid(
            "gutter",
            _gutter(draw, half, out, eaves),
            finishes.bare_metal(draw),
            weather.facing(0.5),
        ),
    ]


def _gutter(draw: Draw, half: float, out: float, eaves: float) -> Mesh:
    """A gutter along the eaves with one or two downpipes."""
    y, x = -out - 0.07, half - 0.45
    pipes = [rod((-half, y, eaves), (half, y, eaves), 0.07, 10)]
    for side in draw.some([-x, x], draw.whole(1, 2)):
        pipes += [
            rod((side, y, eaves), (side, -0.1, eaves - 0.5), 0.045, 10),
            rod((side, -0.1, eaves - 0.5), (side, -0.1, 0.0), 0.045, 10),
        ]
    return merge(pipes)


def flat_roof(draw: Draw, plan: Plan, weather: Weather) -> list[Solid]:
    """A flat roof with a parapet and a projecting edge."""
    a, out, top = plan.length / 2, draw.between(0.05, 0.5), plan.height
    edge = beam(-a - out, a + out, -out, plan.depth + out, top, top + draw.between(0.15, 0.6))
    return [Solid("roof", edge, finishes.matte(draw), weather.facing(0.9))]
