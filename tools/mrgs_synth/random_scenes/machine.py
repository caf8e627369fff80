"""Random machine halls: motors, pumps, tanks, cabinets and pipework in a closed hall."""

from __future__ import annotations

import numpy as np

from mrgs_synth.building import beam
from mrgs_synth.random_scenes import finishes, furniture, machinery
from mrgs_synth.random_scenes.draw import Draw
from mrgs_synth.random_scenes.shell import Climate, Shell
from mrgs_synth.shapes import tube
from mrgs_synth.stage import Solid, Stage, constant

STANDING = (
    machinery.motor_pump,
    machinery.motor_pump,
    machinery.tank,
    machinery.tank,
    machinery.cabinet,
    machinery.cabinet,
    machinery.barrel,
    machinery.railing,
    furniture.stove,
)


def machine(draw: Draw) -> Stage:
    """Draw a hall: its machines, pipes, cables, lamps and cameras."""
    shell = Shell(draw.between(4.0, 8.0), draw.between(4.0, 7.0), draw.between(2.6, 4.2))
    air_c = draw.between(8.0, 34.0)
    climate = Climate(air_c, air_c - draw.between(1.0, 14.0), air_c + draw.between(4.0, 40.0))
    solids = shell.surfaces(draw, climate, rich_floor=draw.chance(0.4))
    solids += _machines(draw, shell, air_c)
    for number in range(draw.whole(1, 5)):
        solids += _pipe(draw, shell, f"run_{number}", air_c)
    solids += _overhead(draw, shell, air_c)
    cameras = shell.cameras(draw, (0.5, 1.1))
    return shell.stage(draw, solids, air_c, cameras, (0.003, 0.015))


def _machines(draw: Draw, shell: Shell, air_c: float) -> list[Solid]:
    """Machines that do not touch, in the back half and along the sides."""
    solids: list[Solid] = []
    taken: list[tuple[float, float, float]] = []
    wanted = draw.whole(3, 9)
    for number in range(8 * wanted):
        x = draw.between(-0.5, 0.5) * (shell.length - 1.2)
        y = draw.between(-0.05, 0.5) * (shell.width - 1.0)
        things = draw.one_of(*STANDING)(draw, f"machine_{number}", air_c)
        corners = np.concatenate([solid.mesh.vertices for solid in things])[:, :2]
        radius = float(np.linalg.norm(corners, axis=1).max())
        if _fits(shell, (x, y, radius), taken):
            taken.append((x, y, radius))
            yaw = draw.one_of(0.0, 0.0, 90.0, -90.0) + draw.between(-12.0, 12.0)
            solids += furniture.placed(things, (x, y, 0.0), yaw)
        if len(taken) == wanted:
            break
    return solids


def _fits(
    shell: Shell, place: tuple[float, float, float], taken: list[tuple[float, float, float]]
) -> bool:
    x, y, radius = place
    free = all(np.hypot(x - a, y - b) > 0.8 * (radius + r) for a, b, r in taken)
    within = abs(x) + radius < shell.length / 2 and abs(y) + radius < shell.width / 2
    return bool(free and within)


def _pipe(draw: Draw, shell: Shell, name: str, air_c: float) -> list[Solid]:
    """A pipe along the back wall or a side wall, through the floor or the ceiling."""
    depth = draw.between(0.12, 0.3)
    low, high = draw.between(0.2, 0.9), draw.between(1.2, shell.height - 0.3)
    first, last = draw.one_of((low, high), (high, low))
    bottom, top = draw.one_of((0.0, shell.height), (0.0, 0.0), (shell.height, shell.height))
    if draw.chance(0.6):
        half, y = shell.length / 2 - 0.35, shell.width / 2 - depth
        start, end = draw.between(-half, -0.1), draw.between(0.1, half)
        path = [
            (start, y, bottom),
            (start, y, first),
            (0.5 * (start + end), y, first),
            (0.5 * (start + end), y, last),
            (end, y, last),
            (end, y, top),
        ]
    else:
        x = draw.one_of(-1.0, 1.0) * (shell.length / 2 - depth)
        start, end = 0.0, shell.width / 2 - 0.4
        path = [(x, start, bottom), (x, start, first), (x, end, first), (x, end, top)]
    return machinery.pipe_run(draw, name, path, air_c)


def _overhead(draw: Draw, shell: Shell, air_c: float) -> list[Solid]:
    """A duct below the ceiling, cables that hang from wall to wall."""
    solids = []
    if draw.chance(0.5):
        y, side = draw.between(0.2, 0.45) * shell.width, draw.between(0.2, 0.4)
        duct = beam(
            -shell.length / 2,
            shell.length / 2,
            y - side,
            y,
            shell.height - side - 0.1,
            shell.height - 0.1,
        )
        look = finishes.bare_metal(draw) if draw.chance(0.7) else finishes.painted(draw)
        solids.append(Solid("duct", duct, look, constant(air_c + draw.between(-8.0, 15.0))))
    for number in range(draw.whole(0, 5)):
        y, sag = draw.between(0.1, 0.48) * shell.width, draw.between(0.1, 0.6)
        t = np.linspace(-1.0, 1.0, 17)
        z = shell.height - 0.3 - sag * (1.0 - t**2)
        path = np.stack([t * shell.length / 2, np.full(17, y), z], axis=-1)
        celsius = constant(air_c + draw.one_of(0.0, 2.0, 12.0))
        cable = tube(path, draw.scale(0.006, 0.02), 7)
        solids.append(
            Solid(f"cable_{number}", cable, finishes.painted(draw, (36, 36, 40)), celsius)
        )
    return solids
