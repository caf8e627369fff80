"""A closed hall or room: floor, walls and ceiling seen from within, its lamps, and the cameras that
fit into it.

The origin is the middle of the floor. The cameras stand in the front half (y < 0) and look towards
the back wall; things stand at the back, at the sides and around the middle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mrgs_synth.cameras import CameraArc
from mrgs_synth.conduction import Contact, Plate, PlateTemperature, solve
from mrgs_synth.random_scenes import finishes
from mrgs_synth.random_scenes.checks import unseen
from mrgs_synth.random_scenes.draw import Draw
from mrgs_synth.random_scenes.fields import floor_heating, hidden_in_wall, touches
from mrgs_synth.random_scenes.sensors import drawn_sensor
from mrgs_synth.shapes import box_faces
from mrgs_synth.stage import Lamp, Material, Solid, Stage, TemperatureField, constant

CELL_M = 0.05
WALLS = ("back", "left", "right", "front")


@dataclass(frozen=True)
class Climate:
    """Temperatures in °C: of the air within, outside, and of what heating pipes carry."""

    air_c: float
    outside_c: float
    pipe_c: float


@dataclass(frozen=True)
class Shell:
    """Length along x, width along y, and height of a room, metres."""

    length: float
    width: float
    height: float

    def wall_length(self, wall: str) -> float:
        """Of the back, front, left or right wall."""
        return self.length if wall in ("back", "front") else self.width

    def surfaces(self, draw: Draw, climate: Climate, rich_floor: bool = True) -> list[Solid]:
        """Floor, ceiling and walls; walls hide thermal bridges and pipes."""
        faces = {
            side: mesh.inside_out()
            for side, mesh in box_faces(self.length, self.width, self.height).items()
        }
        floor = finishes.floor(draw) if rich_floor else finishes.concrete(draw)
        ceiling = finishes.bare_wall(draw, 64, 64, draw.colour((0.0, 0.08), (0.8, 0.95)))
        solids = [
            Solid("floor", faces["bottom"], Material(floor), self._floor_c(draw, climate)),
            Solid("ceiling", faces["top"], Material(ceiling), constant(climate.air_c + 0.8)),
        ]
        rows, same = round(120 * self.height), draw.chance(0.5)
        texture = finishes.indoor_wall(draw, rows, round(120 * self.length))
        for wall in WALLS:
            if not same and wall != "back":
                texture = finishes.indoor_wall(draw, rows, round(120 * self.wall_length(wall)))
            field = self._wall_c(draw, climate, wall)
            solids.append(Solid(f"wall_{wall}", faces[wall], Material(texture), field))
        return solids

    def _floor_c(self, draw: Draw, climate: Climate) -> TemperatureField:
        plate = Plate(self.length, self.width, 0.12, climate.air_c - 0.5, CELL_M)
        _, y = plate.cell_centres()
        contacts = [Contact(y > self.width / 2 - 0.2, climate.outside_c, 0.08)]
        if draw.chance(0.3):
            contacts.append(floor_heating(draw, plate, climate.air_c + draw.between(4.0, 14.0)))
        if draw.chance(0.5):
            contacts += touches(draw, plate, (0.3 * self.length, 0.3 * self.width))
        return solve(plate, contacts).at

    def _wall_c(self, draw: Draw, climate: Climate, wall: str) -> TemperatureField:
        length = self.wall_length(wall)
        outer = draw.chance(0.6)
        behind_c = climate.outside_c if outer else climate.air_c
        ambient_c = climate.air_c - 0.06 * (climate.air_c - behind_c)
        plate = Plate(length, self.height, draw.between(0.1, 0.2), ambient_c, CELL_M)
        contacts = hidden_in_wall(draw, plate, behind_c, climate.pipe_c)
        x, z = plate.cell_centres()
        edge = np.minimum(length / 2 - np.abs(x), self.height / 2 - np.abs(z))
        contacts.append(Contact(edge < 0.08, behind_c, draw.between(0.05, 0.2)))
        if draw.chance(0.35):
            contacts += touches(draw, plate, (0.3 * length, 0.2))
        solved, along = solve(plate, contacts), 0 if wall in ("back", "front") else 1
        rise = draw.between(0.0, 0.9)

        def field(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
            z = points[:, 2] - self.height / 2
            return _at(solved, points[:, along], z) + rise * z

        return field

    def cameras(self, draw: Draw, target_z: tuple[float, float]) -> CameraArc:
        """Arcs about a point near the middle that stay within the room."""
        target = (
            draw.between(-0.12, 0.12) * self.length,
            draw.between(-0.02, 0.2) * self.width,
            draw.between(*target_z),
        )
        middle, half = -90.0 + draw.between(-15.0, 15.0), draw.between(38.0, 70.0)
        azimuths = np.radians(np.linspace(middle - half, middle + half, 25))
        to_side = (self.length / 2 - target[0] * np.sign(np.cos(azimuths))) / np.abs(
            np.cos(azimuths)
        )
        to_front = (self.width / 2 + target[1]) / np.abs(np.sin(azimuths))
        reach = float(np.minimum(to_side, to_front).min()) - 0.3
        rings = []
        for _ in range(draw.whole(2, 4)):
            distance = reach * draw.between(0.62, 0.97)
            highest = np.degrees(np.arcsin(min((self.height - 0.35 - target[2]) / distance, 0.64)))
            rings.append((draw.between(-4.0, float(highest)), distance))
        return CameraArc(
            target,
            (middle - half, middle + half),
            tuple(rings),
            fov_deg=draw.between(55.0, 82.0),
            jitter_m=draw.between(0.01, 0.05),
        )

    def lamps(self, draw: Draw, arc: CameraArc) -> tuple[Lamp, ...]:
        """One to three lamps below the ceiling that no camera sees, of warm or cold white."""
        warmth, wanted = draw.between(0.0, 1.0), draw.whole(1, 3)
        colour = (1.0, 1.0 - 0.16 * warmth, 1.0 - 0.38 * warmth)
        candidates = []
        for _ in range(24):
            at = draw.between(-0.42, 0.42) * self.length, draw.between(-0.46, 0.3) * self.width
            aim = draw.between(-0.2, 0.2) * self.length, draw.between(0.0, 0.3) * self.width
            size, power = draw.between(0.6, 1.3), draw.between(0.5, 1.0)
            candidates.append(
                Lamp(
                    (*at, self.height - 0.1),
                    (*aim, 0.5),
                    (size, size),
                    (power * colour[0], power * colour[1], power * colour[2]),
                )
            )
        return unseen(candidates, arc)[:wanted]

    def stage(
        self,
        draw: Draw,
        solids: Sequence[Solid],
        air_c: float,
        cameras: CameraArc,
        point_noise_m: tuple[float, float],
    ) -> Stage:
        """The closed room with everything in it, lit by its lamps alone.

        Args:
            draw: of emissivities, lamps, noise and sensor, in this order.
            solids: the room's surfaces and all that stands in it.
            air_c: temperature of the air, which rough surfaces reflect, °C.
            cameras: that no lamp may be seen by.
            point_noise_m: least and largest noise of the sparse points, metres.
        """
        return Stage(
            solids=finishes.emissive(solids, draw),
            lamps=self.lamps(draw, cameras),
            sky=None,
            exposure=None,
            cameras=cameras,
            beyond_c=constant(air_c),
            point_noise_m=draw.between(*point_noise_m),
            surroundings_c=constant(air_c),
            sensor=drawn_sensor(draw),
            bounces=2,
            denoised=True,
        )


def _at(
    plate: PlateTemperature, x: Float[np.ndarray, " n"], z: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    return plate.at(np.stack([x, z, z], axis=-1))
