"""Furniture and household things, each made in its own frame: centred, its front towards −y, on
z = 0."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from mrgs_synth import textures
from mrgs_synth.building import beam, rod
from mrgs_synth.random_scenes import finishes
from mrgs_synth.random_scenes.draw import Draw
from mrgs_synth.random_scenes.fields import graded, spotted
from mrgs_synth.shapes import Mesh, box, box_faces, lathe, merge, sphere, tube, without
from mrgs_synth.stage import Material, Solid, TemperatureField, constant

Maker = Callable[[Draw, str, float], list[Solid]]
"""Makes a thing of a name in a room of an air temperature in °C."""


def placed(
    solids: Sequence[Solid], at: tuple[float, float, float], yaw_deg: float = 0.0
) -> list[Solid]:
    """Things made at the origin, moved to their place."""
    return [replace(solid, position=at, yaw_deg=yaw_deg) for solid in solids]


def lived_in(draw: Draw, air_c: float, height: float) -> TemperatureField:
    """Near the air's temperature, a little warmer upwards; now and then somebody has touched it."""
    spots = [((draw.between(-0.3, 0.3), -0.2, 0.7 * height), 0.1, draw.between(1.0, 5.0))]
    base = graded(air_c - 0.6, air_c + 0.4, 2, 0.0, 2.0)
    return spotted(base, spots if draw.chance(0.3) else [])


def table(draw: Draw, name: str, air_c: float, height: float | None = None) -> list[Solid]:
    """A table with four legs, or with two panels."""
    height = height or draw.between(0.45, 0.78)
    length, width = draw.between(0.7, 1.6), draw.between(0.5, 0.85)
    top = beam(-length / 2, length / 2, -width / 2, width / 2, height - 0.03, height)
    a, b = length / 2 - 0.06, width / 2 - 0.06
    if draw.chance(0.6):
        legs = [
            beam(x - 0.025, x + 0.025, y - 0.025, y + 0.025, 0.0, height - 0.03)
            for x in (-a, a)
            for y in (-b, b)
        ]
    else:
        legs = [beam(x - 0.015, x + 0.015, -b, b, 0.0, height - 0.03) for x in (-a, a)]
    look = finishes.household(draw)
    feet = look if draw.chance(0.6) else finishes.bare_metal(draw)
    return [
        Solid(f"{name}_top", top, look, lived_in(draw, air_c, height)),
        Solid(f"{name}_legs", merge(legs), feet, constant(air_c - 0.3)),
    ]


def cupboard(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """A closed cupboard with doors and knobs, low or high."""
    length, width, height = draw.between(0.6, 1.4), draw.between(0.3, 0.5), draw.between(0.7, 1.9)
    faces = box_faces(length, width, height)
    look = finishes.household(draw)
    doors = np.array(look.texture)
    count = draw.whole(1, 4)
    for door in range(count):
        column = round(door / count * doors.shape[1])
        doors[:, column : column + 2] = doors[:2] = 24
    front = replace(look, texture=doors)
    knobs = [
        sphere(0.018, 10).placed(x, -width / 2 - 0.012, 0.55 * height)
        for x in (np.arange(count) + 0.8) / count * length - length / 2
    ]
    field = lived_in(draw, air_c, height)
    return [
        Solid(f"{name}_body", without(faces, "front"), look, field),
        Solid(f"{name}_doors", faces["front"], front, field),
        Solid(f"{name}_knobs", merge(knobs), finishes.bare_metal(draw), constant(air_c)),
    ]


def shelf(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """An open shelf with books, boxes and pots."""
    length, width, floors = draw.between(0.7, 1.3), draw.between(0.26, 0.38), draw.whole(2, 5)
    pitch, half = draw.between(0.28, 0.38), length / 2
    height = floors * pitch
    boards = [
        beam(-half, half, -width / 2, width / 2, k * pitch, k * pitch + 0.02)
        for k in range(floors + 1)
    ]
    boards += [
        beam(x - 0.012, x + 0.012, -width / 2, width / 2, 0.0, height + 0.02) for x in (-half, half)
    ]
    back = beam(-half, half, width / 2 - 0.01, width / 2, 0.0, height)
    solids = [
        Solid(f"{name}_boards", merge([*boards, back]), finishes.wooden(draw), constant(air_c))
    ]
    shades: dict[int, list[Mesh]] = {}
    for level in range(floors):
        x = -half + 0.04
        while x < half - 0.12:
            thick, tall = draw.between(0.02, 0.07), draw.between(0.5, 0.85) * pitch
            deep = draw.between(0.5, 0.85) * width
            z = level * pitch + 0.02
            book = beam(x, x + thick, width / 2 - 0.02 - deep, width / 2 - 0.02, z, z + tall)
            shades.setdefault(draw.whole(0, 4), []).append(book)
            x += thick + (draw.between(0.05, 0.3) if draw.chance(0.2) else 0.003)
    for shade, books in sorted(shades.items()):
        look = finishes.painted(draw) if shade % 2 else finishes.matte(draw)
        solids.append(Solid(f"{name}_books_{shade}", merge(books), look, constant(air_c + 0.1)))
    return solids


def sofa(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """An upholstered seat; one place of it is still warm."""
    length, width = draw.between(0.8, 1.9), draw.between(0.75, 0.95)
    half, deep = length / 2, width / 2
    parts = [
        beam(-half, half, -deep, deep, 0.08, 0.26),
        beam(-half + 0.15, half - 0.15, -deep - 0.03, deep - 0.2, 0.26, 0.43),
        beam(-half, half, deep - 0.2, deep, 0.26, 0.8),
        beam(-half, -half + 0.15, -deep, deep - 0.2, 0.26, 0.6),
        beam(half - 0.15, half, -deep, deep - 0.2, 0.26, 0.6),
    ]
    cloth = textures.weave(96, 96, [draw.colour()], [draw.colour()], 16)
    look = Material(cloth) if draw.chance(0.5) else finishes.matte(draw)
    seat = draw.between(-0.25, 0.25) * length
    warm = [
        ((seat, -0.05, 0.43), 0.16, draw.between(1.0, 6.0)),
        ((seat, deep - 0.2, 0.65), 0.14, draw.between(0.5, 4.0)),
    ]
    field = spotted(constant(air_c - 0.2), warm if draw.chance(0.6) else [])
    return [Solid(f"{name}_seat", merge(parts), look, field)]


def chair(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """A chair of rods and boards: thin parts."""
    look = finishes.bare_metal(draw) if draw.chance(0.3) else finishes.household(draw)
    seat = draw.between(0.42, 0.48)
    parts: list[Mesh] = [beam(-0.21, 0.21, -0.21, 0.21, seat - 0.025, seat)]
    parts += [rod((x, -0.18, 0.0), (x, -0.18, seat - 0.02), 0.014, 8) for x in (-0.18, 0.18)]
    parts += [rod((x, 0.19, 0.0), (x, 0.22, 0.9), 0.014, 8) for x in (-0.18, 0.18)]
    parts += [beam(-0.18, 0.18, 0.195, 0.215, z, z + 0.05) for z in (0.6, 0.72, 0.84)]
    return [Solid(f"{name}", merge(parts), look, lived_in(draw, air_c, seat))]


def stove(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """A cooker, a boiler or a heater: a box whose front and top are hot."""
    length, width, height = draw.between(0.45, 0.65), 0.55, draw.between(0.6, 0.95)
    faces = box_faces(length, width, height)
    rise = draw.scale(8.0, 60.0)
    spots = [
        ((0.0, -width / 2, 0.5 * height), 0.16, rise),
        ((draw.between(-0.12, 0.12), 0.0, height), 0.1, draw.between(0.4, 1.2) * rise),
    ]

    field = spotted(constant(air_c + 0.08 * rise), spots)
    colour = draw.colour((0.0, 0.3), (0.3, 0.95))
    window = textures.plain(colour, draw.rng, 128)
    window[40:88, 24:104] = (20, 22, 26)
    window[12:20, 20:108:22] = window[12:20, 21:108:22] = (210, 210, 206)
    pipe = rod((0.0, 0.15, height), (0.0, 0.15, height + 0.9), 0.06, 20)
    solids = [
        Solid(f"{name}_body", without(faces, "front"), finishes.painted(draw, colour), field),
        Solid(f"{name}_front", faces["front"], Material(window, "glossy", 0.15), field),
    ]
    if draw.chance(0.5):
        hot = graded(air_c + rise, air_c + 0.3 * rise, 2, height, height + 0.9)
        solids.append(Solid(f"{name}_pipe", pipe, finishes.bare_metal(draw), hot))
    return solids


def radiator(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """A panel radiator with pipes and a valve; it may be cold or hold air at its top."""
    length, height, lift = draw.between(0.5, 1.4), draw.between(0.4, 0.7), 0.12
    warm = air_c + draw.one_of(0.0, 6.0, 18.0, 30.0, 42.0) * draw.between(0.7, 1.0)
    cool = warm - 0.3 * (warm - air_c) * draw.between(0.3, 1.5)
    field = graded(cool, warm, 2, lift, lift + height)
    if draw.chance(0.3):
        field = spotted(field, [((0.3 * length, 0.0, lift + height), 0.15, 0.5 * (cool - warm))])
    texture = textures.plain((226, 224, 216), draw.rng, 256)
    texture[:, :: draw.whole(10, 24)] = 150
    pipes = [
        rod((x, 0.0, 0.0), (x, 0.0, lift + 0.06), 0.011, 10)
        for x in (-length / 2 + 0.05, -length / 2 + 0.12)
    ]
    valve = rod(
        (-length / 2 + 0.05, -0.08, lift + 0.05), (-length / 2 + 0.05, 0.0, lift + 0.05), 0.022, 16
    )
    return [
        Solid(
            f"{name}_panel",
            box(length, 0.09, height).placed(0.0, 0.0, lift),
            Material(texture, "glossy", 0.3),
            field,
        ),
        Solid(
            f"{name}_pipes",
            merge([*pipes, valve]),
            finishes.painted(draw, (230, 228, 222)),
            constant(warm),
        ),
    ]


def plant(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """A pot with leaves on thin stems."""
    radius, height = draw.between(0.08, 0.16), draw.between(0.12, 0.28)
    pot = lathe(
        [(0.0, 0.0), (0.75 * radius, 0.0)],
        [(0.75 * radius, 0.0), (radius, height)],
        [(radius, height), (0.0, height - 0.01)],
        segments=24,
    )
    leaves = []
    for _ in range(draw.whole(8, 22)):
        turn, out = draw.between(0.0, 2.0 * np.pi), draw.between(0.06, 0.3)
        up = height + draw.between(0.1, 0.6)
        tip = np.array([out * np.cos(turn), out * np.sin(turn), up])
        path = np.stack([[0.0, 0.0, height], 0.4 * tip + [0.0, 0.0, 0.55 * up], tip])
        leaves.append(tube(path, 0.004, 5))
        leaf = sphere(draw.between(0.03, 0.07), 10)
        leaves.append(replace(leaf, vertices=leaf.vertices * [1.0, 1.0, 0.25] + tip))
    green = textures.plain((draw.whole(40, 90), draw.whole(90, 150), draw.whole(40, 70)), draw.rng)
    return [
        Solid(
            f"{name}_pot",
            pot,
            draw.one_of(finishes.matte, finishes.painted)(draw),
            graded(air_c - 1.5, air_c - 0.5, 2, 0.0, height),
        ),
        Solid(f"{name}_leaves", merge(leaves), Material(green), constant(air_c - 1.2)),
    ]


def vessel(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """A mug, a bottle, a pot or a vase, full of something hot, cold, or nothing."""
    radius, height = draw.scale(0.03, 0.1), draw.scale(0.08, 0.3)
    waist, neck = draw.between(0.8, 1.2), draw.between(0.3, 1.0)
    profile = [
        (0.9 * radius, 0.0),
        (radius, 0.15 * height),
        (waist * radius, 0.55 * height),
        (0.5 * (waist + neck) * radius, 0.8 * height),
        (neck * radius, height),
    ]
    body = lathe(
        [(0.0, 0.0), (0.9 * radius, 0.0)],
        profile,
        [(neck * radius, height), (0.0, height)],
        segments=32,
    )
    inside_c = draw.one_of(air_c, air_c - 0.5, 5.0, 38.0, 55.0, 75.0)
    level = draw.between(0.4, 0.9) * height
    field = graded(inside_c, 0.6 * air_c + 0.4 * inside_c, 2, level, level + 0.04)
    colours = [(share, draw.colour((0.1, 0.7))) for share in (0.3, 0.5, 0.8, 1.0)]
    look = Material(textures.bands(96, 96, colours, draw.rng), "glossy", 0.15)
    if draw.chance(0.3):
        look = finishes.bare_metal(draw)
    return [Solid(name, body, look, field)]


def device(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """A powered box: a router, an amplifier, a power supply, a laptop."""
    length, width = draw.between(0.12, 0.4), draw.between(0.1, 0.26)
    height = draw.between(0.02, 0.12)
    faces = box_faces(length, width, height)
    spots = [
        (
            (draw.between(-0.4, 0.4) * length, draw.between(-0.4, 0.4) * width, height),
            draw.between(0.1, 0.3) * length,
            draw.scale(2.0, 25.0),
        )
        for _ in range(draw.whole(1, 3))
    ]
    field = spotted(constant(air_c + draw.between(0.5, 5.0)), spots)
    lid = Material(textures.instrument_panel(120, 180, draw.rng), "glossy", 0.25)
    return [
        Solid(f"{name}_lid", faces["top"], lid, field),
        Solid(f"{name}_case", without(faces, "top"), finishes.painted(draw), field),
    ]


def carton(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """A box or a book; sometimes it has just come in from the cold."""
    size = (draw.between(0.12, 0.45), draw.between(0.1, 0.35), draw.between(0.03, 0.35))
    palette = [draw.colour((0.1, 0.6)) for _ in range(4)]
    if draw.chance(0.4):
        look = finishes.matte(draw, (176, 136, 92))
    else:
        look = Material(textures.title_page(120, 160, palette, draw.rng), "glossy", 0.25)
    return [Solid(name, box(*size), look, constant(draw.one_of(air_c, air_c, air_c - 6.0)))]


def screen(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """A flat screen on a foot, warmer where its electronics are."""
    length, height = draw.between(0.5, 1.0), draw.between(0.3, 0.55)
    panel = box_faces(length, 0.04, height)
    lift = {side: mesh.placed(0.0, 0.0, 0.08) for side, mesh in panel.items()}
    shown = textures.plain((22, 24, 28), draw.rng, 96)
    if draw.chance(0.5):
        palette = [draw.colour((0.3, 0.8)) for _ in range(4)]
        shown = textures.geometric(96, 160, palette, 20, draw.rng)
    rise = draw.one_of(0.3, 8.0, 16.0)
    field = spotted(constant(air_c + 0.4 * rise), [((0.2 * length, 0.0, 0.2 * height), 0.12, rise)])
    black = finishes.painted(draw, (38, 38, 40))
    foot = merge([box(0.3, 0.16, 0.015), box(0.05, 0.03, 0.1).placed(0.0, 0.0, 0.0)])
    return [
        Solid(f"{name}_front", lift["front"], finishes.glass(draw, shown), field),
        Solid(f"{name}_back", merge([without(lift, "front"), foot]), black, field),
    ]


def standing_lamp(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """A thin pole with a shade that is warm at its top; it gives no light to the photos."""
    height = draw.between(1.1, 1.7)
    shade = lathe(
        [(0.0, height - 0.22), (0.19, height - 0.22)],
        [(0.19, height - 0.22), (0.12, height)],
        [(0.12, height), (0.0, height)],
        segments=28,
    )
    pole = merge(
        [
            rod((0.0, 0.0, 0.0), (0.0, 0.0, height - 0.22), 0.012, 10),
            rod((0.0, 0.0, 0.0), (0.0, 0.0, 0.02), 0.15, 28),
        ]
    )
    hot = graded(air_c + 2.0, air_c + draw.one_of(2.0, 12.0, 30.0), 2, height - 0.22, height)
    return [
        Solid(f"{name}_shade", shade, finishes.matte(draw, (232, 220, 196)), hot),
        Solid(f"{name}_pole", pole, finishes.bare_metal(draw), constant(air_c)),
    ]


STANDING: tuple[Maker, ...] = (cupboard, shelf, sofa, stove, plant, chair, standing_lamp, table)
SMALL: tuple[Maker, ...] = (vessel, vessel, device, carton, plant, screen)
