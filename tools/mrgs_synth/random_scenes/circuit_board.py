"""Random circuit boards: powered, on a bench, with parts, defects and things around them drawn.

The origin lies on the bench below the board's centre. Everything is made for the air and the load
of the scene ``electronics``; its temperatures are then mapped to those that were drawn, which heat
conduction allows, because it is linear.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from mrgs_synth import circuit, components, textures
from mrgs_synth.building import rod
from mrgs_synth.cameras import CameraArc
from mrgs_synth.circuit import Footprint
from mrgs_synth.components import AIR_C, BOARD_THICKNESS_M, STANDOFF_M, TOP_M, Package
from mrgs_synth.conduction import Contact, Plate, PlateTemperature, solve
from mrgs_synth.random_scenes import finishes, furniture
from mrgs_synth.random_scenes.checks import unseen
from mrgs_synth.random_scenes.draw import Draw
from mrgs_synth.random_scenes.sensors import drawn_sensor
from mrgs_synth.shapes import box_faces, merge, tube, without
from mrgs_synth.stage import Lamp, Material, Solid, Stage, TemperatureField, constant

BENCH_M = (1.3, 1.1)
Pads: TypeAlias = Literal["two rows", "four rows", "ends", "grid", "none"]
Sort: TypeAlias = tuple[str, tuple[float, float, float], Pads, int]
"""The letter of a part, its size in millimetres, its pads, and how many in a row."""


def circuit_board(draw: Draw) -> Stage:
    """Draw a board, its parts and faults, the bench, the lamps and the cameras."""
    size_mm = draw.between(80.0, 190.0), draw.between(60.0, 130.0)
    parts = _parts(draw, size_mm)
    plate = Plate(size_mm[0] / 1000.0, size_mm[1] / 1000.0, draw.between(0.009, 0.02), 30.0, 0.0012)
    board = solve(plate, _contacts(draw, plate, parts))
    solids = _board(draw, size_mm, parts, board)
    for part, top_c in parts.items():
        solids += _part(draw, part, top_c, board)
    solids += _bench(draw, size_mm, max(parts.values()))
    air_c, load = (
        draw.between(15.0, 30.0),
        draw.one_of(0.12, 0.5, 0.9, 1.2) * draw.between(0.8, 1.2),
    )
    cameras = _cameras(draw, size_mm)
    return Stage(
        solids=finishes.emissive([_loaded(solid, air_c, load) for solid in solids], draw),
        lamps=_lamps(draw, cameras),
        sky=(0.35, 0.36, 0.38),
        exposure=None,
        cameras=cameras,
        beyond_c=constant(air_c),
        point_noise_m=draw.between(0.0002, 0.0006),
        surroundings_c=constant(air_c),
        sensor=drawn_sensor(draw),
        bounces=2,
        denoised=True,
    )


def _loaded(solid: Solid, air_c: float, load: float) -> Solid:
    """The temperatures at another air temperature and another share of the power."""
    return replace(
        solid, temperature_c=lambda points: air_c + load * (solid.temperature_c(points) - AIR_C)
    )


def _cameras(draw: Draw, size_mm: tuple[float, float]) -> CameraArc:
    fov_deg = draw.between(34.0, 58.0)
    far = 0.5 * float(np.hypot(*size_mm)) / 1000.0 / np.tan(np.radians(fov_deg / 2))
    rings = tuple(
        (draw.between(28.0, 72.0), float(far * draw.between(0.8, 1.35)))
        for _ in range(draw.whole(2, 4))
    )
    middle, half = draw.between(-180.0, 180.0), draw.between(55.0, 165.0)
    x, y = (draw.between(-0.1, 0.1) * s / 1000.0 for s in size_mm)
    target = (x, y, 0.012)
    return CameraArc(
        target,
        (middle - half, middle + half),
        rings,
        fov_deg=fov_deg,
        jitter_m=draw.between(0.001, 0.005),
    )


def _lamps(draw: Draw, arc: CameraArc) -> tuple[Lamp, ...]:
    warmth, wanted = draw.between(0.0, 1.0), draw.whole(1, 3)
    candidates = []
    for _ in range(20):
        turn, out, side = draw.between(0.0, 6.28), draw.between(0.3, 1.2), draw.between(0.2, 0.6)
        power = draw.between(4.0, 16.0)
        place = (out * np.cos(turn), out * np.sin(turn), draw.between(0.7, 1.3))
        radiance = (power, power * (1.0 - 0.1 * warmth), power * (1.0 - 0.3 * warmth))
        candidates.append(Lamp(place, (0.0, 0.0, 0.0), (side, side), radiance))
    return unseen(candidates, arc)[:wanted]


def _parts(draw: Draw, size_mm: tuple[float, float]) -> dict[Footprint, float]:
    """Parts that do not touch, and the temperatures of their tops, °C; few are hot."""
    parts: dict[Footprint, float] = {}
    wanted = draw.whole(8, 28)
    chips = draw.whole(20, 90)
    for number in range(6 * wanted + 4 * chips):
        large = len(parts) < wanted and number < 6 * wanted
        if len(parts) >= wanted + chips:
            break
        name, size, pads, count = _package(draw) if large else _chip(draw)
        reach = [(a - b) / 2 - 3.0 for a, b in zip(size_mm, size, strict=False)]
        if min(reach) <= 0.0:
            continue
        x, y = (round(draw.between(-r, r), 1) for r in reach)
        part = Footprint(f"{name}{number}", x, y, size, pads, count)
        if not any(_too_near(part, other) for other in parts):
            hot = draw.chance(0.3 if large else 0.12)
            parts[part] = draw.between(45.0, 88.0) if hot else draw.between(28.0, 42.0)
    return parts


def _package(draw: Draw) -> Sort:
    """Letter, size in millimetres, and pads of a large part."""
    side = draw.between(7.0, 24.0)
    sorts: tuple[Sort, ...] = (
        ("U", (side, side, draw.between(1.0, 2.6)), "four rows", draw.whole(8, 20)),
        ("U", (side, 0.6 * side, draw.between(1.0, 2.0)), "two rows", draw.whole(4, 12)),
        ("Q", (6.6, 7.0, 2.3), "ends", 1),
        ("D", (5.0, 3.6, 2.2), "ends", 1),
        ("L", (0.6 * side + 3.0, 0.6 * side + 3.0, draw.between(3.0, 8.0)), "ends", 1),
        ("K", (19.0, 15.0, draw.between(10.0, 16.0)), "two rows", 4),
        ("C", (0.3 * side + 4.0, 0.3 * side + 4.0, draw.between(6.0, 18.0)), "none", 1),
        ("C", (0.3 * side + 4.0, 0.3 * side + 4.0, draw.between(6.0, 18.0)), "none", 1),
        ("T", (side + 4.0, side + 4.0, 7.0), "none", 1),
        (
            "J",
            (draw.between(12.0, 22.0), draw.between(10.0, 16.0), draw.between(6.0, 14.0)),
            "none",
            1,
        ),
        ("H", (2.54 * draw.whole(4, 16), 5.0, 8.5), "grid", 8),
        ("V", (24.0, 26.0, draw.between(18.0, 30.0)), "none", 1),
    )
    return draw.one_of(*sorts)


def _chip(draw: Draw) -> Sort:
    length, width, height = draw.one_of((3.2, 1.6, 0.8), (2.0, 1.25, 0.9), (6.4, 3.2, 1.0))
    size = (length, width, height) if draw.chance(0.6) else (width, length, height)
    return draw.one_of("R", "X"), size, "ends", 1


def _too_near(part: Footprint, other: Footprint) -> bool:
    """Whether less than 1.5 mm of free board is between two parts and their leads."""
    return all(
        abs(a - b) < (part.size_mm[axis] + other.size_mm[axis]) / 2 + 3.0
        for axis, (a, b) in enumerate(((part.x_mm, other.x_mm), (part.y_mm, other.y_mm)))
    )


def _under(plate: Plate, part: Footprint) -> Bool[np.ndarray, "rows columns"]:
    x, y = plate.cell_centres()
    centre, (length, width, _) = part.centre_m, part.size_m
    return (np.abs(x - centre[0]) < length / 2) & (np.abs(y - centre[1]) < width / 2)


def _contacts(draw: Draw, plate: Plate, parts: dict[Footprint, float]) -> list[Contact]:
    """Heat from the parts, a short circuit under the mask, and cool connectors."""
    contacts = []
    for part, top_c in parts.items():
        if part.name[0] in "JH":
            contacts.append(Contact(_under(plate, part), AIR_C + 4.0, 2.0))
        else:
            contacts.append(Contact(_under(plate, part), top_c - 2.0, draw.scale(0.3, 5.0)))
    x, y = plate.cell_centres()
    for _ in range(draw.whole(0, 2)):
        start, level = (
            draw.between(-0.4, 0.1) * plate.length_m,
            draw.between(-0.4, 0.4) * plate.width_m,
        )
        end = start + draw.between(0.01, 0.04)
        short = (x > start) & (x < end) & (np.abs(y - level) < 0.0013)
        contacts.append(Contact(short, draw.between(45.0, 75.0), 8.0))
    return contacts


def _board(
    draw: Draw, size_mm: tuple[float, float], parts: dict[Footprint, float], board: PlateTemperature
) -> list[Solid]:
    """The board with its solder mask of some colour, on pillars."""
    look = circuit.board(size_mm, list(parts), f"REV {draw.whole(1, 9)}", draw.rng)
    look = look[:, :, draw.one_of((0, 1, 2), (0, 1, 2), (0, 2, 1), (1, 0, 2), (2, 0, 1))]
    if draw.chance(0.2):
        look = (0.5 * look.mean(axis=2, keepdims=True) + 0.2 * look).astype(np.uint8)
    length, width = size_mm[0] / 1000.0, size_mm[1] / 1000.0
    faces = box_faces(length, width, BOARD_THICKNESS_M)
    place = (0.0, 0.0, STANDOFF_M)
    corners = [
        (x, y)
        for x in (-length / 2 + 0.004, length / 2 - 0.004)
        for y in (-width / 2 + 0.004, width / 2 - 0.004)
    ]
    pillars = [rod((x, y, 0.0), (x, y, TOP_M + 0.002), 0.0025, 12) for x, y in corners]
    fr4 = finishes.matte(draw, (150, 146, 100))
    return [
        Solid("board", faces["top"], Material(look, "glossy", 0.25), board.at, place),
        Solid("board_sides", without(faces, "top"), fr4, board.at, place),
        Solid("pillars", merge(pillars), finishes.bare_metal(draw), lambda p: board.at(p) - 1.0),
    ]


def _part(draw: Draw, part: Footprint, top_c: float, board: PlateTemperature) -> list[Solid]:
    letter, rng = part.name[0], draw.rng
    if letter == "C":
        return components.capacitor(part, top_c - 8.0, board, rng)
    if letter == "T":
        return [components.toroid(part, rng)]
    if letter == "J":
        return components.connector(part, 30.0, rng)
    if letter == "H":
        count = round(part.size_mm[0] / 2.54)
        return components.header(replace(part, count=count), rng)
    if letter == "V":
        return _named(components.regulator(part, rng), part.name)
    if letter in "RX":
        colour = (40, 40, 42) if letter == "R" else (176, 138, 100)
        rise = 0.25 * (top_c - 30.0)
        return [
            Solid(part.name, part.body(TOP_M), finishes.painted(draw, colour), _warmer(board, rise))
        ]
    marking = (
        f"{draw.one_of('MR', 'TX', 'ALS', 'GT')}{draw.whole(100, 9999)}",
        f"{draw.whole(10, 99)}-{draw.whole(1, 52)}",
    )
    colour = draw.one_of(
        (44, 44, 48), (44, 44, 48), (70, 70, 74), draw.colour((0.2, 0.7), (0.2, 0.6))
    )
    return components.package(Package(part, top_c, 1.0, marking, colour), board, rng)


def _named(solids: list[Solid], name: str) -> list[Solid]:
    return [replace(solid, name=f"{name}_{solid.name}") for solid in solids]


def _warmer(board: PlateTemperature, rise_c: float) -> TemperatureField:
    return lambda points: board.at(points) + rise_c


def _bench(draw: Draw, size_mm: tuple[float, float], hottest_c: float) -> list[Solid]:
    """The bench, warm below the board and where something lay; cables, and things beside the
    board."""
    plate = Plate(*BENCH_M, draw.between(0.012, 0.03), AIR_C, 0.008)
    x, y = plate.cell_centres()
    half = size_mm[0] / 2000.0, size_mm[1] / 2000.0
    warmth = [Contact((np.abs(x) < half[0]) & (np.abs(y) < half[1]), 34.0, draw.between(0.3, 1.0))]
    if draw.chance(0.6):
        centre = (
            draw.one_of(-1.0, 1.0) * (half[0] + draw.between(0.04, 0.15)),
            draw.between(-0.1, 0.1),
        )
        ghost = (np.abs(x - centre[0]) < draw.between(0.02, 0.08)) & (np.abs(y - centre[1]) < 0.05)
        warmth.append(Contact(ghost, AIR_C + draw.between(3.0, 12.0), 0.8))
    top = draw.one_of(_mat, finishes.floor, _wooden_top)(draw)
    faces = box_faces(*BENCH_M, 0.03)
    solids = [
        Solid("bench", faces["top"], Material(top), solve(plate, warmth).at, (0.0, 0.0, -0.03)),
        Solid(
            "bench_sides",
            without(faces, "top"),
            finishes.wooden(draw),
            constant(AIR_C),
            (0.0, 0.0, -0.03),
        ),
    ]
    for number in range(draw.whole(0, 5)):
        hot = constant(AIR_C + draw.one_of(0.5, 3.0, 0.35 * (hottest_c - AIR_C)))
        cable = tube(_cable_path(draw, half), draw.scale(0.0008, 0.003), 8)
        solids.append(Solid(f"cable_{number}", cable, finishes.painted(draw), hot))
    for number in range(draw.whole(0, 4)):
        turn, out = draw.between(0.0, 6.28), float(np.hypot(*half)) + draw.between(0.1, 0.3)
        place = (out * float(np.cos(turn)), out * float(np.sin(turn)), 0.0)
        thing = draw.one_of(furniture.vessel, furniture.device, _tool, _tool)
        solids += furniture.placed(
            thing(draw, f"thing_{number}", AIR_C), place, draw.between(0.0, 360.0)
        )
    return solids


def _mat(draw: Draw) -> textures.Texture:
    return circuit.cutting_mat((330.0, 280.0), draw.rng)


def _wooden_top(draw: Draw) -> textures.Texture:
    return textures.wood(500, 600, draw.whole(3, 10), draw.rng, (120, 84, 52), (206, 164, 112))


def _cable_path(draw: Draw, half: tuple[float, float]) -> Float[np.ndarray, "n 3"]:
    """From a place on the board over its edge, then along the bench."""
    side, y = draw.one_of(-1.0, 1.0), draw.between(-0.8, 0.8) * half[1]
    x = np.array([0.8, 0.9, 1.0, 1.15, 1.4, 1.9, 2.8, 3.8]) * half[0]
    z = np.array([TOP_M, TOP_M + 0.012, TOP_M + 0.016, 0.012, 0.004, 0.004, 0.004, 0.004])
    sway = y + draw.between(-0.5, 0.5) * half[1] * np.linspace(0.0, 1.5, 8) ** 2
    t, fine = np.arange(8), np.linspace(0.0, 7.0, 40)
    return np.stack([np.interp(fine, t, c) for c in (side * x, sway, z)], axis=-1)


def _tool(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """A screwdriver or a soldering iron that is still warm."""
    length, warm = draw.between(0.06, 0.12), air_c + draw.one_of(0.0, 0.5, 30.0)
    grip = rod((0.0, 0.0, 0.011), (-0.1, 0.0, 0.011), 0.011, 18)
    blade = rod((0.0, 0.0, 0.011), (length, 0.0, 0.011), 0.003, 10)
    return [
        Solid(f"{name}_grip", grip, finishes.painted(draw), constant(0.7 * air_c + 0.3 * warm)),
        Solid(f"{name}_blade", blade, finishes.bare_metal(draw), constant(warm)),
    ]
