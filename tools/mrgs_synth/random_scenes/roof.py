"""Random roofs seen from above: pitched ones with solar modules, flat ones with machines, vents and
wet insulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mrgs_synth.building import beam, prism, rod
from mrgs_synth.cameras import CameraArc
from mrgs_synth.conduction import Contact, Plate, solve
from mrgs_synth.random_scenes import finishes, surroundings
from mrgs_synth.random_scenes.draw import Draw
from mrgs_synth.random_scenes.fields import graded, spotted
from mrgs_synth.random_scenes.sensors import drawn_sensor
from mrgs_synth.random_scenes.solar import modules
from mrgs_synth.random_scenes.weather import Weather
from mrgs_synth.shapes import Mesh, box, box_faces, lathe, merge, sphere, tube, without
from mrgs_synth.stage import Material, Solid, Stage, TemperatureField, constant


def roof(draw: Draw) -> Stage:
    """Draw a building, its roof and what is on it, the weather and the cameras."""
    weather = Weather.drawn(draw)
    length, width = draw.between(7.0, 15.0), draw.between(6.0, 10.0)
    base = draw.between(2.6, 7.0)
    if draw.chance(0.5):
        solids, top = _pitched(draw, weather, (length, width, base))
    else:
        solids, top = _flat(draw, weather, (length, width, base))
    solids += [*surroundings.ground(draw, weather, []), *surroundings.neighbours(draw, weather)]
    places = [(s * (length / 2 + 2.5), draw.between(-4.0, 3.0)) for s in (-1.0, 1.0)]
    solids += surroundings.plants(draw, weather, places[: draw.whole(0, 2)])
    if draw.chance(0.5):
        at = (draw.between(-4.0, 4.0), -width / 2 - 3.5)
        solids += surroundings.vehicle(draw, weather, "car", at, draw.between(0.0, 360.0))
    return Stage(
        solids=finishes.emissive(solids, draw),
        lamps=(),
        sky=weather.light(draw),
        exposure=None,
        cameras=_cameras(draw, length, top),
        beyond_c=weather.sky_c,
        point_noise_m=draw.between(0.008, 0.025),
        surroundings_c=weather.surroundings_c,
        sensor=drawn_sensor(draw),
        bounces=2,
        denoised=True,
    )


def _cameras(draw: Draw, length: float, top: float) -> CameraArc:
    """A drone's arcs above the roof."""
    fov_deg = draw.between(45.0, 75.0)
    far = 0.5 * length / np.tan(np.radians(fov_deg / 2))
    rings = tuple(
        (draw.between(20.0, 68.0), float(far * draw.between(0.65, 1.2)) + 2.0)
        for _ in range(draw.whole(2, 4))
    )
    middle, half = -90.0 + draw.between(-30.0, 30.0), draw.between(45.0, 150.0)
    target = (draw.between(-0.1, 0.1) * length, draw.between(-1.0, 0.5), top - 0.3)
    return CameraArc(
        target,
        (middle - half, middle + half),
        rings,
        fov_deg=fov_deg,
        jitter_m=draw.between(0.04, 0.2),
    )


def tilted(solid: Solid, angle_deg: float, at: tuple[float, float, float]) -> Solid:
    """A solid turned about the x axis, its back upwards, and moved; its temperatures move with
    it."""
    cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    turn = np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])
    mesh = Mesh(
        solid.mesh.vertices @ turn.T, solid.mesh.normals @ turn.T, solid.mesh.uv, solid.mesh.faces
    )
    return replace(
        solid,
        mesh=mesh,
        position=at,
        temperature_c=lambda points: solid.temperature_c(points @ turn),
    )


def _pitched(
    draw: Draw, weather: Weather, size: tuple[float, float, float]
) -> tuple[list[Solid], float]:
    """A gabled roof; its front side carries modules, windows, vents and a chimney."""
    length, width, base = size
    angle = draw.between(15.0, 42.0)
    slope, rise = width / 2 / np.cos(np.radians(angle)), width / 2 * np.tan(np.radians(angle))
    tiles = finishes.clay(draw, 320, 560)
    plate = Plate(length, slope, 0.15, weather.air_c + weather.sun_c, 0.08)
    x, v = plate.cell_centres()
    contacts = [Contact((x + 100.0) % 0.8 < 0.09, weather.indoors_c, draw.between(0.0, 0.12))]
    for _ in range(draw.whole(1, 5)):
        bare = np.hypot(x - draw.between(-0.5, 0.5) * length, v - draw.between(-0.5, 0.5) * slope)
        contacts.append(
            Contact(bare < draw.between(0.2, 0.9), weather.indoors_c, draw.between(0.1, 0.5))
        )
    solved = solve(plate, contacts)
    sheet = box_faces(length, slope, 0.1)
    eaves = (0.0, -width / 2, base)
    deck = [
        Solid(
            "roof_front",
            sheet["top"].placed(0.0, slope / 2, -0.1),
            Material(tiles),
            lambda points: solved.at(points - np.array([0.0, slope / 2, 0.0])),
        ),
        Solid(
            "roof_edge",
            without(sheet, "top").placed(0.0, slope / 2, -0.1),
            finishes.wooden(draw),
            weather.facing(0.5),
        ),
    ]
    deck += _on_slope(draw, weather, length, slope)
    solids = [tilted(solid, angle, eaves) for solid in deck]
    back = Solid(
        "roof_back",
        box(length, slope, 0.1).placed(0.0, slope / 2, -0.1),
        Material(tiles),
        weather.facing(0.7),
    )
    solids.append(replace(tilted(back, angle, (0.0, width / 2, base)), yaw_deg=180.0))
    solids += _body(draw, weather, (length - 0.6, width - 0.6, base), rise)
    at, top = draw.between(-0.42, 0.42) * length, base + rise
    stack = beam(at - 0.3, at + 0.3, 0.1, 0.7, base + 0.4 * rise, top + draw.between(0.4, 1.0))
    hot = constant(weather.air_c + draw.one_of(0.5, 6.0, 20.0))
    solids.append(Solid("chimney", stack, finishes.matte(draw, (150, 84, 64)), hot))
    if draw.chance(0.5):
        solids += _antenna(draw, weather, (draw.between(-0.4, 0.4) * length, 0.0, top - 0.1))
    return solids, top


def _on_slope(draw: Draw, weather: Weather, length: float, slope: float) -> list[Solid]:
    """Modules on the lower or upper part, roof windows and vents beside them; z is off the roof."""
    rows, columns = max(1, min(draw.whole(1, 3), int(slope / 1.9))), draw.whole(3, 8)
    columns = min(columns, int((length - 1.0) / 1.7))
    left = draw.between(-length / 2 + 0.4, length / 2 - 0.6 - 1.66 * columns)
    low = draw.between(0.3, max(slope - 1.7 * rows - 0.3, 0.31))
    solids = []
    if draw.chance(0.85):
        at = (left, low, 0.04)
        solids = [
            replace(s, mesh=s.mesh.placed(*at), temperature_c=_moved(s.temperature_c, at))
            for s in modules(draw, weather, "array", columns, rows)
        ]
    for number in range(draw.whole(0, 3)):
        x = draw.one_of(
            left - draw.between(0.8, 2.5), left + 1.7 * columns + draw.between(0.8, 2.5)
        )
        v, tall = draw.between(0.8, slope - 0.8), draw.between(0.5, 1.0)
        if abs(x) > length / 2 - 0.6:
            continue
        pane = box(0.8, tall, 0.1).placed(x, v, 0.0)
        warm = (
            weather.air_c
            + 0.4 * weather.sun_c
            + draw.between(0.2, 0.6) * (weather.indoors_c - weather.air_c)
        )
        solids.append(Solid(f"skylight_{number}", pane, finishes.glass(draw), constant(warm)))
    for number in range(draw.whole(0, 4)):
        x, v = draw.between(-0.46, 0.46) * length, draw.between(0.85, 0.95) * slope
        pipe = rod((x, v, 0.0), (x, v, draw.between(0.3, 0.6)), 0.07, 16)
        exhaust = constant(weather.air_c + draw.one_of(1.0, 5.0, 10.0))
        solids.append(Solid(f"vent_{number}", pipe, finishes.painted(draw), exhaust))
    return solids


def _moved(field: TemperatureField, offset: tuple[float, float, float]) -> TemperatureField:
    return lambda points: field(points - np.array(offset))


def _body(
    draw: Draw, weather: Weather, size: tuple[float, float, float], rise: float
) -> list[Solid]:
    """The walls below the roof, and gables up to it."""
    length, width, base = size
    walls = [box(length, width, base)]
    if rise > 0.0:
        walls.append(_gable(length, width, base, rise))
    look = Material(finishes.outside_wall(draw, 200, 400))
    warm = 0.06 * (weather.indoors_c - weather.air_c)
    slab = [((0.0, -width / 2, 0.5 * base), 1.5, 2.0 * warm)]
    return [Solid("walls", merge(walls), look, spotted(weather.facing(0.5), slab))]


def _gable(length: float, width: float, base: float, rise: float) -> Mesh:
    outline = np.array([(-width / 2, base), (width / 2, base), (0.0, base + 0.9 * rise)])
    gable = prism(outline, length)
    return gable.placed(0.0, 0.0, 0.0, 90.0)


def _antenna(draw: Draw, weather: Weather, foot: tuple[float, float, float]) -> list[Solid]:
    """A mast with thin cross rods and a wire."""
    x, y, z = foot
    tall = draw.between(1.0, 2.2)
    parts = [rod(foot, (x, y, z + tall), 0.025, 8)]
    parts += [
        rod((x - 0.35, y, z + tall - s), (x + 0.35, y, z + tall - s), 0.012, 6)
        for s in (0.05, 0.2, 0.35)
    ]
    return [Solid("antenna", merge(parts), finishes.bare_metal(draw), weather.facing(0.5))]


def _flat(
    draw: Draw, weather: Weather, size: tuple[float, float, float]
) -> tuple[list[Solid], float]:
    """A flat roof with a parapet: membrane or gravel over insulation that is wet in places."""
    length, width, base = size
    plate = Plate(length, width, 0.25, weather.air_c + 0.9 * weather.sun_c, 0.1)
    x, y = plate.cell_centres()
    contacts = []
    for _ in range(draw.whole(1, 5)):
        centre = draw.between(-0.45, 0.45) * length, draw.between(-0.45, 0.45) * width
        reach = draw.between(0.5, 1.8)
        wet = np.hypot((x - centre[0]) * draw.between(0.6, 1.5), y - centre[1]) < reach
        contacts.append(Contact(wet, weather.indoors_c, draw.between(0.1, 0.5)))
    solved = solve(plate, contacts)
    tone = draw.whole(70, 190)
    membrane = finishes.tiled(draw, 512, 512, draw.whole(60, 200), (tone, tone, tone - 4))
    gravel = finishes.concrete(draw)
    deck = box_faces(length, width, 0.2)
    at = (0.0, 0.0, base)
    rim, high = draw.between(0.15, 0.35), draw.between(0.2, 0.7)
    a, b, z = length / 2, width / 2, base + 0.2
    edges = [beam(-a, a, y0, y0 + rim, z, z + high) for y0 in (-b, b - rim)]
    edges += [beam(x0, x0 + rim, -b + rim, b - rim, z, z + high) for x0 in (-a, a - rim)]
    solids = [
        Solid("deck", deck["top"], Material(draw.one_of(membrane, gravel)), solved.at, at),
        Solid("deck_edge", without(deck, "top"), finishes.matte(draw), weather.facing(0.5), at),
        Solid(
            "parapet",
            merge(edges),
            finishes.bare_metal(draw) if draw.chance(0.3) else finishes.matte(draw),
            weather.facing(0.7),
        ),
        *_body(draw, weather, size, 0.0),
    ]
    return [*solids, *_on_deck(draw, weather, (length, width, z))], z


def _on_deck(draw: Draw, weather: Weather, size: tuple[float, float, float]) -> list[Solid]:
    """Rows of tilted modules, units, domes, vents and pipes, none on another."""
    length, width, z = size
    solids: list[Solid] = []
    taken: list[tuple[float, float, float]] = []
    for number in range(draw.whole(4, 12)):
        kind = draw.one_of("modules", "modules", "unit", "unit", "dome", "vent", "antenna")
        columns, angle = draw.whole(2, 4), draw.between(8.0, 30.0)
        radius = {"modules": 0.85 * columns, "unit": 1.1}.get(kind, 0.6)
        for _ in range(10):
            x, y = (draw.between(-0.5, 0.5) * (s - 2.0 * radius - 0.8) for s in (length, width))
            if all(np.hypot(x - u, y - v) > 0.9 * (radius + r) for u, v, r in taken):
                break
        else:
            continue
        taken.append((x, y, radius))
        name, at = f"{kind}_{number}", (x, y, z)
        if kind == "modules":
            field = modules(draw, weather, name, columns, 1)
            corner = (x - 0.8 * columns, y - 0.6, z + 0.12)
            solids += [tilted(solid, angle, corner) for solid in field]
            solids.append(_rack(draw, weather, name, corner, columns))
        elif kind == "unit":
            unit = surroundings.box_unit(draw, weather, name)
            yaw = draw.one_of(0.0, 90.0) + draw.between(-5.0, 5.0)
            solids += [replace(part, position=at, yaw_deg=yaw) for part in unit]
        elif kind == "antenna":
            mast = _antenna(draw, weather, at)
            solids += [replace(part, name=f"{name}_{part.name}") for part in mast]
        else:
            solids += (
                _dome(draw, weather, name, at) if kind == "dome" else _vent(draw, weather, name, at)
            )
    return [*solids, *_cable(draw, weather, length, width, z)]


def _rack(
    draw: Draw, weather: Weather, name: str, corner: tuple[float, float, float], columns: int
) -> Solid:
    """The rails that tilted modules rest on."""
    x, y, z = corner
    rails = [
        beam(x + s, x + s + 0.06, y, y + 0.9, z - 0.12, z + 0.02)
        for s in np.linspace(0.1, columns - 0.2, columns + 1)
    ]
    return Solid(f"{name}_rack", merge(rails), finishes.bare_metal(draw), weather.facing(0.4))


def _dome(draw: Draw, weather: Weather, name: str, at: tuple[float, float, float]) -> list[Solid]:
    """A skylight of curved plastic on a curb; heat escapes through it."""
    radius = draw.between(0.3, 0.55)
    cap = sphere(radius, 24)
    cap = replace(
        cap, vertices=(cap.vertices - [0.0, 0.0, radius]) * [1.0, 1.0, 0.6] + [0.0, 0.0, 0.25]
    )
    warm = (
        weather.air_c
        + 0.4 * weather.sun_c
        + draw.between(0.2, 0.6) * (weather.indoors_c - weather.air_c)
    )
    return [
        Solid(f"{name}_cap", cap, finishes.painted(draw, (216, 222, 226)), constant(warm), at),
        Solid(
            f"{name}_curb",
            box(2.1 * radius, 2.1 * radius, 0.25),
            finishes.matte(draw),
            weather.facing(0.6),
            at,
        ),
    ]


def _vent(draw: Draw, weather: Weather, name: str, at: tuple[float, float, float]) -> list[Solid]:
    """An exhaust with a rain hood."""
    radius, tall = draw.between(0.08, 0.25), draw.between(0.4, 1.1)
    shape = merge(
        [
            lathe([(radius, 0.0), (radius, tall)], [(radius, tall), (0.0, tall)], segments=24),
            lathe(
                [(0.0, tall + 0.1), (1.6 * radius, tall + 0.1)],
                [(1.6 * radius, tall + 0.1), (0.0, tall + 0.1 + 0.8 * radius)],
                segments=24,
            ),
            rod((0.0, 0.0, tall), (0.0, 0.0, tall + 0.1), 0.4 * radius, 8),
        ]
    )
    warm = draw.one_of(1.0, 6.0, 14.0, 25.0)
    field = graded(weather.air_c + 0.3 * warm, weather.air_c + warm, 2, 0.0, tall)
    look = finishes.bare_metal(draw) if draw.chance(0.5) else finishes.painted(draw)
    return [Solid(name, shape, look, field, at)]


def _cable(draw: Draw, weather: Weather, length: float, width: float, z: float) -> list[Solid]:
    """A cable or pipe that winds over the roof."""
    if draw.chance(0.4):
        return []
    t = np.linspace(-0.45, 0.45, 40)
    y = draw.between(-0.3, 0.3) * width + draw.between(0.1, 0.6) * np.sin(
        draw.between(4.0, 14.0) * t
    )
    radius = draw.scale(0.015, 0.06)
    path = np.stack([t * length, y, np.full(40, z + radius)], axis=-1)
    warm = constant(weather.air_c + draw.one_of(0.5, 3.0, 12.0))
    return [Solid("cable", tube(path, radius, 8), finishes.painted(draw, (40, 40, 42)), warm)]
