"""Machines and pipework, each made in its own frame: its front towards −y, on z = 0."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from mrgs_synth import circuit, textures
from mrgs_synth.building import beam, rod
from mrgs_synth.random_scenes import finishes
from mrgs_synth.random_scenes.draw import Draw
from mrgs_synth.random_scenes.fields import graded, spotted
from mrgs_synth.shapes import Mesh, box_faces, lathe, merge, tube, without
from mrgs_synth.stage import Material, Solid, TemperatureField, constant

Point = tuple[float, float, float]


def motor_pump(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """A finned motor on a frame that drives a pump; a bearing or a coupling may run hot."""
    radius, length = draw.between(0.1, 0.22), draw.between(0.35, 0.7)
    axis, start = radius + draw.between(0.1, 0.3), -0.7 * length
    running = draw.chance(0.75)
    warm_c = air_c + (draw.between(8.0, 45.0) if running else draw.between(0.0, 2.0))
    bearing = (start + length, 0.0, axis), 0.5 * radius, draw.one_of(2.0, 10.0, 35.0) * running
    motor_c = spotted(graded(warm_c, warm_c + 4.0, 0, start, start + length), [bearing])
    turn = np.linspace(0.0, 2.0 * np.pi, draw.whole(14, 26), endpoint=False)
    body = [rod((start, 0.0, axis), (start + length, 0.0, axis), radius, 28)]
    body += [
        rod(
            (start + 0.04, 1.03 * radius * np.cos(a), axis + 1.03 * radius * np.sin(a)),
            (start + length - 0.06, 1.03 * radius * np.cos(a), axis + 1.03 * radius * np.sin(a)),
            0.008,
            5,
        )
        for a in turn
    ]
    body.append(beam(start + 0.1, start + 0.26, -0.06, 0.06, axis + radius, axis + radius + 0.07))
    end, wide = start + length + draw.between(0.12, 0.25), draw.between(1.0, 1.5) * radius
    fluid_c = draw.one_of(air_c, air_c - 8.0, air_c + 20.0, air_c + 45.0)
    pump = [
        rod((end, 0.0, axis), (end + 0.7 * wide, 0.0, axis), wide, 28),
        rod((end + 0.7 * wide, 0.0, axis), (end + 2.2 * wide, 0.0, axis), 0.4 * wide, 20),
        rod(
            (end + 0.35 * wide, 0.7 * wide, axis),
            (end + 0.35 * wide, 0.7 * wide, axis + 2.6 * wide),
            0.3 * wide,
            20,
        ),
        rod(
            (end + 0.35 * wide, 0.7 * wide, axis + 2.2 * wide),
            (end + 0.35 * wide, 0.7 * wide, axis + 2.2 * wide + 0.03),
            0.5 * wide,
            24,
        ),
    ]
    shaft = rod((start + length, 0.0, axis), (end, 0.0, axis), 0.03, 14)
    frame = [
        beam(start, end + wide, y - 0.03, y + 0.03, 0.0, 0.08)
        for y in (-0.6 * radius, 0.6 * radius)
    ]
    frame += [
        beam(x - 0.04, x + 0.04, -0.7 * radius, 0.7 * radius, 0.08, axis - 0.6 * radius)
        for x in (start + 0.12, start + length - 0.12, end + 0.3 * wide)
    ]
    return [
        Solid(f"{name}_motor", merge(body), finishes.painted(draw), motor_c),
        Solid(f"{name}_pump", merge(pump), finishes.painted(draw), constant(fluid_c)),
        Solid(
            f"{name}_shaft", shaft, finishes.bare_metal(draw), spotted(constant(warm_c), [bearing])
        ),
        Solid(f"{name}_frame", merge(frame), finishes.painted(draw), constant(air_c + 0.5)),
    ]


def tank(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """An upright vessel on legs; heat shows how full it is, and where its insulation is missing."""
    radius, height, lift = draw.between(0.22, 0.5), draw.between(0.7, 1.5), draw.between(0.12, 0.4)
    dome = [
        (radius * np.cos(a), height + 0.35 * radius * np.sin(a))
        for a in np.linspace(0.0, np.pi / 2, 8)
    ]
    dome[-1] = (0.0, dome[-1][1])
    shell = lathe(
        [(0.0, 0.0), (radius, 0.0)],
        [(radius, 0.0), (radius, 0.5 * height), (radius, height)],
        dome,
        segments=40,
    ).placed(0.0, 0.0, lift)
    full_c = air_c + draw.one_of(-10.0, 6.0, 25.0, 50.0) * draw.between(0.6, 1.0)
    level = lift + draw.between(0.2, 0.9) * height
    turn = draw.between(-2.4, -0.7)
    bare = (radius * np.cos(turn), radius * np.sin(turn), lift + draw.between(0.2, 0.8) * height)
    field = spotted(
        graded(full_c, air_c + 0.2 * (full_c - air_c), 2, level, level + draw.between(0.02, 0.2)),
        [(bare, 0.12, 0.4 * (full_c - air_c))] if draw.chance(0.4) else [],
    )
    legs = [
        rod(
            (0.8 * radius * np.cos(a), 0.8 * radius * np.sin(a), 0.0),
            (0.8 * radius * np.cos(a), 0.8 * radius * np.sin(a), lift + 0.02),
            0.03,
            10,
        )
        for a in (0.8, 2.4, 3.9, 5.5)
    ]
    bands = [
        rod((0.0, 0.0, lift + z * height), (0.0, 0.0, lift + z * height + 0.03), 1.01 * radius, 40)
        for z in (0.25, 0.75)
    ]
    look = finishes.bare_metal(draw) if draw.chance(0.35) else finishes.painted(draw)
    steel = finishes.bare_metal(draw)
    return [
        Solid(f"{name}_shell", shell, look, field),
        Solid(f"{name}_legs", merge(legs), finishes.painted(draw), constant(air_c)),
        Solid(f"{name}_bands", merge(bands), steel, field),
    ]


def cabinet(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """An electrical cabinet: closed, with a warm place on its door, or open, with one hot breaker
    among many."""
    length, width, height = draw.between(0.5, 0.9), draw.between(0.3, 0.45), draw.between(0.9, 2.0)
    faces = box_faces(length, width, height)
    grey = finishes.painted(draw, draw.colour((0.0, 0.15), (0.5, 0.9)))
    inside_c = air_c + draw.between(1.0, 8.0)
    field = graded(air_c + 0.5, inside_c, 2, 0.0, height)
    solids = [Solid(f"{name}_case", without(faces, "front"), grey, field)]
    if draw.chance(0.45):
        door = textures.plain(draw.colour((0.0, 0.15), (0.5, 0.9)), draw.rng, 128)
        door[20:44, 30:98] = (236, 200, 60)
        door[96:120:6, 24:104] = 30
        hot = (
            (draw.between(-0.2, 0.2), -width / 2, draw.between(0.4, 0.8) * height),
            0.15,
            draw.scale(2.0, 12.0),
        )
        look = Material(door, "glossy", 0.3)
        return [*solids, Solid(f"{name}_door", faces["front"], look, spotted(field, [hot]))]
    back = Material(textures.plain((226, 222, 206), draw.rng))
    solids.append(Solid(f"{name}_plate", faces["front"], back, field))
    hottest, rows = draw.scale(6.0, 50.0), draw.whole(2, 5)
    for row in range(rows):
        z = (row + 0.6) / (rows + 0.6) * height
        rise = hottest if draw.chance(0.5) else 2.0
        solids += _breakers(draw, f"{name}_{row}", (length, -width / 2, z), inside_c, rise)
    return solids


def _breakers(draw: Draw, name: str, place: Point, inside_c: float, rise_c: float) -> list[Solid]:
    """A row of breakers and their wires; one breaker and its wire are warmer than the others.

    Args:
        draw: chooses their number and colours, and which is warm.
        name: of the row.
        place: length of the row, and y and z of its back and lower edge, metres.
        inside_c: temperature of the others, °C.
        rise_c: how much warmer the one is, °C.
    """
    length, front, z = place
    xs = np.arange(-length / 2 + 0.06, length / 2 - 0.08, draw.between(0.05, 0.1))
    breakers = [beam(x, x + 0.04, front - 0.06, front, z, z + 0.09) for x in xs]
    at = float(draw.rng.choice(xs)) + 0.02, front - 0.05, z + 0.06
    colour = draw.colour((0.0, 0.3), (0.15, 0.8))
    look = Material(circuit.marked(("C16",), (64, 64), draw.rng, colour))
    bend = [(0.02, -0.03, 0.09), (0.02, -0.04, 0.13), (0.05, -0.03, 0.17), (0.05, -0.008, 0.2)]
    corners = [np.array(bend) + np.array([x, front, z]) for x in xs[:: draw.whole(1, 2)]]
    wires = [tube(path, 0.006, 6) for path in corners]
    warm = spotted(constant(inside_c + 1.0), [(at, 0.025, rise_c)])
    wire_c = spotted(constant(inside_c), [(at, 0.05, 0.6 * rise_c)])
    return [
        Solid(f"{name}_breakers", merge(breakers), look, warm),
        Solid(f"{name}_wires", merge(wires), finishes.painted(draw), wire_c),
    ]


def barrel(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """A drum or a gas bottle."""
    radius, height = draw.between(0.12, 0.29), draw.between(0.6, 1.1)
    shape = lathe(
        [(0.0, 0.0), (radius, 0.0)],
        [(radius, 0.0), (radius, 0.88 * height)],
        [(radius, 0.88 * height), (0.7 * radius, 0.97 * height), (0.0, height)],
        segments=32,
    )
    level = draw.between(0.2, 0.8) * height
    field = graded(air_c - draw.one_of(0.2, 1.0, 4.0), air_c, 2, level, level + 0.05)
    return [Solid(name, shape, finishes.painted(draw), field)]


def railing(draw: Draw, name: str, air_c: float) -> list[Solid]:
    """A guard rail of thin tubes."""
    length, radius = draw.between(0.8, 1.8), draw.between(0.012, 0.025)
    parts = [
        rod((x, 0.0, 0.0), (x, 0.0, 1.0), radius, 8)
        for x in np.linspace(-length / 2, length / 2, draw.whole(2, 5))
    ]
    parts += [rod((-length / 2, 0.0, z), (length / 2, 0.0, z), radius, 8) for z in (0.5, 1.0)]
    look = finishes.painted(draw, (226, 190, 40)) if draw.chance(0.5) else finishes.bare_metal(draw)
    return [Solid(name, merge(parts), look, constant(air_c - 0.2))]


def pipe_run(draw: Draw, name: str, path: Sequence[Point], air_c: float) -> list[Solid]:
    """A pipe along straight pieces, with flanges, a valve, and perhaps a torn insulation or a leak.

    Args:
        draw: chooses the size, the fluid and what is wrong with it.
        name: of its solids.
        path: corners, metres.
        air_c: temperature of the air, °C.
    """
    radius = draw.scale(0.02, 0.09)
    fluid_c = air_c + draw.one_of(-12.0, 3.0, 18.0, 40.0, 65.0) * draw.between(0.6, 1.0)
    insulated = draw.chance(0.4)
    surface_c = air_c + (0.12 if insulated else 0.85) * (fluid_c - air_c)
    look = finishes.bare_metal(draw) if draw.chance(0.5) else finishes.painted(draw)
    corners = np.array(path)
    piece = int(np.argmax(np.linalg.norm(np.diff(corners, axis=0), axis=1)))
    middle = corners[piece] + draw.between(0.25, 0.75) * (corners[piece + 1] - corners[piece])
    torn = [(tuple(middle.tolist()), 2.0 * radius, fluid_c - surface_c)]
    field = spotted(constant(surface_c), torn if draw.chance(0.6) else [])
    solids = [Solid(f"{name}_pipe", tube(rounded(corners, 2.5 * radius), radius, 16), look, field)]
    along = corners[piece + 1] - corners[piece]
    valve, handle = _valve(middle, along / np.linalg.norm(along), radius)
    valve_c = constant(0.5 * (surface_c + fluid_c))
    red = finishes.painted(draw, (190, 40, 36))
    solids += [
        Solid(f"{name}_valve", valve, finishes.bare_metal(draw), valve_c),
        Solid(f"{name}_wheel", handle, red, constant(surface_c)),
    ]
    if draw.chance(0.45):
        solids.append(_puddle(draw, name, middle, fluid_c, air_c))
    return solids


def _valve(
    middle: Float[np.ndarray, "3"], along: Float[np.ndarray, "3"], radius: float
) -> tuple[Mesh, Mesh]:
    """Two flanges on a pipe with a stem between them, and the wheel on the stem."""
    stem = middle + np.array([0.0, -4.0 * radius, 0.0])
    body = [_straight(middle, stem, 0.5 * radius, 10)]
    for side in (2.0 * radius, -2.0 * radius):
        ends = middle - side * along, middle - (side - 0.02) * along
        body.append(_straight(*ends, 1.6 * radius, 20))
    angle = np.linspace(0.0, 2.0 * np.pi, 17)
    wheel = stem + 2.2 * radius * np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], axis=-1)
    spokes = [_straight(wheel[k], wheel[k + 8], 0.12 * radius, 5) for k in (0, 4)]
    return merge(body), merge([tube(wheel, 0.22 * radius, 8), *spokes])


def _straight(
    start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"], radius: float, segments: int
) -> Mesh:
    return tube(np.stack([start, end]), radius, segments)


def rounded(corners: Float[np.ndarray, "n 3"], radius: float) -> Float[np.ndarray, "m 3"]:
    """A path whose corners are bent, without a cusp."""
    path = [corners[0]]
    for before, corner, after in zip(corners, corners[1:], corners[2:], strict=False):
        first, second = before - corner, after - corner
        reach = min(radius, 0.45 * np.linalg.norm(first), 0.45 * np.linalg.norm(second))
        a = corner + reach * first / np.linalg.norm(first)
        b = corner + reach * second / np.linalg.norm(second)
        path += [
            (1 - t) ** 2 * a + 2 * t * (1 - t) * corner + t**2 * b for t in np.linspace(0.0, 1.0, 7)
        ]
    return np.array([*path, corners[-1]])


def _puddle(
    draw: Draw, name: str, below: Float[np.ndarray, "3"], fluid_c: float, air_c: float
) -> Solid:
    """What has dripped onto the floor, still warm or cold in its middle."""
    radius = draw.between(0.12, 0.4)
    turn = np.linspace(0.0, 2.0 * np.pi, 33)[:-1]
    edge = radius * (1.0 + 0.25 * np.sin(2 * turn + draw.between(0, 6)) + 0.12 * np.sin(5 * turn))
    x, y = edge * np.cos(turn), edge * np.sin(turn)
    rim = np.stack([x, y, np.full(32, 0.003)], axis=-1)
    vertices = np.concatenate([[[0.0, 0.0, 0.003]], rim])
    index = np.arange(1, 33)
    faces = np.stack([np.zeros(32, dtype=int), index, np.roll(index, -1)], axis=-1)
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), vertices.shape)
    mesh = Mesh(vertices, up, 0.5 + 0.4 * vertices[:, :2] / radius, faces)
    wet = Material(textures.plain((52, 54, 58), draw.rng, 64), "glossy", 0.06)
    field = _fading(draw.between(0.4, 0.9) * (fluid_c - air_c), 0.6 * radius, air_c - 1.0)
    return Solid(f"{name}_puddle", mesh, wet, field, (float(below[0]), float(below[1]) - 0.1, 0.0))


def _fading(rise_c: float, size: float, around_c: float) -> TemperatureField:
    return spotted(constant(around_c), [((0.0, 0.0, 0.0), size, rise_c)])
