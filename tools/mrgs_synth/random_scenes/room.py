"""Random rooms: furnished, heated or cold, with windows, radiators, appliances and what walls
hide."""

from __future__ import annotations

import numpy as np

from mrgs_synth import textures
from mrgs_synth.building import Opening, beam, pane, window_frame
from mrgs_synth.random_scenes import finishes, furniture
from mrgs_synth.random_scenes.draw import Draw
from mrgs_synth.random_scenes.fields import graded, spotted
from mrgs_synth.random_scenes.shell import Climate, Shell
from mrgs_synth.shapes import box_faces, merge, tube
from mrgs_synth.stage import Material, Solid, Stage, TemperatureField, constant


def room(draw: Draw) -> Stage:
    """Draw a room: its size, climate, furniture, windows, lamps and cameras."""
    shell = Shell(draw.between(3.4, 6.5), draw.between(3.4, 6.0), draw.between(2.3, 3.1))
    climate = _climate(draw)
    solids = [*shell.surfaces(draw, climate), *_walls(draw, shell, climate)]
    solids += _middle(draw, shell, climate.air_c)
    cameras = shell.cameras(draw, (0.6, 1.2))
    return shell.stage(draw, solids, climate.air_c, cameras, (0.003, 0.012))


def _climate(draw: Draw) -> Climate:
    """A heated room in winter, an unheated one, or a hot summer day."""
    air_c = draw.between(17.0, 24.0)
    return draw.one_of(
        Climate(air_c, draw.between(-8.0, 6.0), draw.between(32.0, 60.0)),
        Climate(air_c, draw.between(-8.0, 6.0), draw.between(32.0, 60.0)),
        Climate(air_c, air_c - 4.0, air_c + draw.between(1.0, 3.0)),
        Climate(air_c + 5.0, draw.between(32.0, 42.0), 14.0),
    )


def _walls(draw: Draw, shell: Shell, climate: Climate) -> list[Solid]:
    """What stands and hangs along the back and side walls, from one end to the other."""
    solids: list[Solid] = []
    for wall, start, end in (
        ("back", -shell.length / 2 + 0.1, shell.length / 2 - 0.1),
        ("left", draw.between(-0.1, 0.1) * shell.width, shell.width / 2 - 0.6),
        ("right", draw.between(-0.1, 0.1) * shell.width, shell.width / 2 - 0.6),
    ):
        along, number = start, 0
        while along < end - 0.6:
            things, length = _along_wall(draw, shell, climate, f"{wall}_{number}")
            if along + length > end:
                break
            solids += _against(shell, wall, along + length / 2, things)
            along += length + draw.between(0.05, 0.7)
            number += 1
    return solids


def _along_wall(draw: Draw, shell: Shell, climate: Climate, name: str) -> tuple[list[Solid], float]:
    """Something at a wall, whose back is the plane y = 0, and its length."""
    kind = draw.one_of("stand", "stand", "stand", "window", "picture", "radiator", "cable", "gap")
    if kind == "gap":
        return [], draw.between(0.4, 1.2)
    if kind == "window":
        return _window(draw, shell, climate, name)
    if kind == "picture":
        return _picture(draw, name, climate.air_c)
    if kind == "cable":
        return _cable(draw, shell, name, climate.air_c)
    if kind == "radiator":
        things = furniture.radiator(draw, name, climate.air_c)
    else:
        things = draw.one_of(*furniture.STANDING)(draw, name, climate.air_c)
        if name.split("_")[0] != "back" or draw.chance(0.5):
            things += _on_top(draw, things, name, climate.air_c)
    corners = np.concatenate([solid.mesh.vertices for solid in things])
    low, high = corners.min(axis=0), corners.max(axis=0)
    moved = [
        Solid(
            s.name,
            s.mesh.placed(-(low[0] + high[0]) / 2, -high[1] - 0.03, 0.0),
            s.material,
            _shifted(s, (low[0] + high[0]) / 2, high[1] + 0.03),
        )
        for s in things
    ]
    return moved, float(high[0] - low[0])


def _shifted(solid: Solid, x: float, y: float, z: float = 0.0) -> TemperatureField:
    """The temperatures of a solid whose mesh has been moved by (−x, −y, −z)."""
    offset = np.array([x, y, z])
    return lambda points: solid.temperature_c(points + offset)


def _against(shell: Shell, wall: str, along: float, things: list[Solid]) -> list[Solid]:
    """Move things whose back is y = 0 to a wall."""
    if wall == "back":
        return furniture.placed(things, (along, shell.width / 2, 0.0))
    if wall == "left":
        return furniture.placed(things, (-shell.length / 2, along, 0.0), 90.0)
    return furniture.placed(things, (shell.length / 2, along, 0.0), -90.0)


def _on_top(draw: Draw, things: list[Solid], name: str, air_c: float) -> list[Solid]:
    """Nothing or one small thing on top of furniture with a flat top."""
    if not things[0].name.endswith(("_top", "_body", "_boards")):
        return []
    top = float(things[0].mesh.vertices[:, 2].max())
    small = draw.one_of(*furniture.SMALL)(draw, f"{name}_small", air_c)
    return [
        Solid(s.name, s.mesh.placed(0.0, 0.0, top), s.material, _shifted(s, 0.0, 0.0, -top))
        for s in small
    ]


def _window(draw: Draw, shell: Shell, climate: Climate, name: str) -> tuple[list[Solid], float]:
    """A window or a glazed door with its frame and sill."""
    low = draw.one_of(0.05, draw.between(0.8, 1.0))
    top = min(draw.between(1.7, 2.3), shell.height - 0.15)
    opening = Opening(name, 0.0, low, draw.between(0.7, 1.8), top - low)
    cold = climate.air_c + draw.between(0.25, 0.55) * (climate.outside_c - climate.air_c)
    field = graded(cold, 0.7 * cold + 0.3 * climate.air_c, 2, low, top)
    if draw.chance(0.4):
        leak = 0.5 * (climate.outside_c - climate.air_c)
        field = spotted(field, [((opening.left, -0.02, low), draw.between(0.1, 0.4), leak)])
    frame = window_frame(opening, -0.1, (draw.whole(1, 3), draw.whole(1, 2)))
    sill = beam(opening.left - 0.08, opening.right + 0.08, -0.2, 0.0, low - 0.04, low)
    view = textures.blend(
        draw.colour((0.1, 0.4), (0.1, 0.4)),
        draw.colour((0.05, 0.3), (0.5, 0.9)),
        textures.noise(96, 96, (4, 3), draw.rng),
    )
    edge_c = 0.5 * (cold + climate.air_c)
    return [
        Solid(f"{name}_glass", pane(opening, -0.03), finishes.glass(draw, view), field),
        Solid(f"{name}_frame", merge([frame, sill]), finishes.painted(draw), constant(edge_c)),
    ], opening.width + 0.2


def _picture(draw: Draw, name: str, air_c: float) -> tuple[list[Solid], float]:
    """A framed picture; or a noticeboard."""
    length, height, z = draw.between(0.3, 1.0), draw.between(0.3, 0.8), draw.between(1.0, 1.4)
    palette = [draw.colour((0.1, 0.8)) for _ in range(4)]
    texture = textures.geometric(160, 200, palette, draw.whole(8, 30), draw.rng)
    faces = {s: m.placed(0.0, -0.02, z) for s, m in box_faces(length, 0.03, height).items()}
    rim = [faces[side] for side in ("top", "bottom", "left", "right")]
    return [
        Solid(f"{name}_print", faces["front"], Material(texture), constant(air_c - 0.4)),
        Solid(f"{name}_rim", merge(rim), finishes.wooden(draw), constant(air_c - 0.3)),
    ], length + 0.1


def _cable(draw: Draw, shell: Shell, name: str, air_c: float) -> tuple[list[Solid], float]:
    """A cable or a pipe on the wall, thin; it may be warm."""
    length, radius = draw.between(0.3, 1.0), draw.scale(0.006, 0.03)
    turn = draw.between(0.5, shell.height - 0.5)
    path = np.array(
        [
            (-length / 2, -radius - 0.01, 0.0),
            (-length / 2, -radius - 0.01, turn - 0.03),
            (-length / 2 + 0.03, -radius - 0.01, turn),
            (length / 2 - 0.03, -radius - 0.01, turn),
            (length / 2, -radius - 0.01, turn + 0.03),
            (length / 2, -radius - 0.01, shell.height),
        ]
    )
    look = finishes.bare_metal(draw) if radius > 0.015 else finishes.painted(draw)
    celsius = air_c + draw.one_of(0.5, 6.0, 25.0, -8.0)
    return [Solid(name, tube(path, radius, 10), look, constant(celsius))], length + 2 * radius


def _middle(draw: Draw, shell: Shell, air_c: float) -> list[Solid]:
    """A table with things on it, or some single piece, around the middle of the room."""
    at = draw.between(-0.12, 0.12) * shell.length, draw.between(0.02, 0.15) * shell.width
    yaw = draw.between(-40.0, 40.0)
    things = furniture.table(draw, "table", air_c)
    top = things[0].mesh.vertices[:, :].max(axis=0)
    solids = furniture.placed(things, (*at, 0.0), yaw)
    turn = np.radians(yaw)
    for number in range(draw.whole(1, 5)):
        x, y = draw.between(-0.8, 0.8) * top[0], draw.between(-0.7, 0.7) * top[1]
        place = (
            at[0] + x * np.cos(turn) - y * np.sin(turn),
            at[1] + x * np.sin(turn) + y * np.cos(turn),
            float(top[2]),
        )
        small = draw.one_of(*furniture.SMALL)(draw, f"thing_{number}", air_c)
        solids += furniture.placed(small, place, draw.between(0.0, 360.0))
    if draw.chance(0.6):
        beside = (at[0] + draw.one_of(-1.0, 1.0) * (top[0] + 0.35), at[1] + 0.1, 0.0)
        solids += furniture.placed(
            furniture.chair(draw, "chair", air_c), beside, draw.between(0.0, 360.0)
        )
    return solids
