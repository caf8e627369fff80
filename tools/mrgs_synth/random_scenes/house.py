"""Random façades: the front of a house with its windows, thermal bridges and leaks.

The wall's face is the plane y = 0, x to the right, z up from the ground; the cameras stand at
negative y.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mrgs_synth import textures
from mrgs_synth.building import Opening, beam, pane, pierced_wall, reveal, rod, window_frame
from mrgs_synth.cameras import CameraArc
from mrgs_synth.conduction import Contact, Plate, solve
from mrgs_synth.random_scenes import finishes, surroundings
from mrgs_synth.random_scenes.draw import Draw
from mrgs_synth.random_scenes.fields import graded, hidden_in_wall, spotted
from mrgs_synth.random_scenes.house_plan import Plan, drawn_plan, flat_roof, gabled_roof
from mrgs_synth.random_scenes.sensors import drawn_sensor
from mrgs_synth.random_scenes.weather import Weather
from mrgs_synth.shapes import box_faces, merge
from mrgs_synth.stage import Material, Solid, Stage, TemperatureField, constant


def house(draw: Draw) -> Stage:
    """Draw a house, the weather, what stands before it, and the cameras."""
    plan, weather = drawn_plan(draw), Weather.drawn(draw)
    solids = [*_walls(draw, plan, weather), *_windows(draw, plan, weather)]
    solids += draw.one_of(gabled_roof, gabled_roof, flat_roof)(draw, plan, weather)
    solids += [*_attached(draw, plan, weather), *_yard(draw, plan, weather)]
    return Stage(
        solids=finishes.emissive(solids, draw),
        lamps=(),
        sky=weather.light(draw),
        exposure=None,
        cameras=_cameras(draw, plan),
        beyond_c=weather.sky_c,
        point_noise_m=draw.between(0.008, 0.025),
        surroundings_c=weather.surroundings_c,
        sensor=drawn_sensor(draw),
        bounces=2,
        denoised=True,
    )


def _cameras(draw: Draw, plan: Plan) -> CameraArc:
    """Arcs in front of the wall that hold most of it in view, from eye level to a mast or a
    drone."""
    fov_deg = draw.between(42.0, 70.0)
    size = max(plan.length, 1.3 * plan.height)
    far = 0.5 * size / np.tan(np.radians(fov_deg / 2))
    z = plan.height * draw.between(0.35, 0.55)
    rings = []
    for _ in range(draw.whole(2, 4)):
        distance = float(far * draw.between(0.6, 1.15))
        eye = draw.one_of(1.6, 1.6, draw.between(1.4, 1.2 * plan.height))
        rings.append(
            (float(np.degrees(np.arcsin(np.clip((eye - z) / distance, -0.5, 0.7)))), distance)
        )
    half, middle = draw.between(30.0, 58.0), -90.0 + draw.between(-12.0, 12.0)
    target = (draw.between(-0.1, 0.1) * plan.length, 0.0, z)
    return CameraArc(
        target,
        (middle - half, middle + half),
        tuple(rings),
        fov_deg=fov_deg,
        jitter_m=draw.between(0.04, 0.15),
    )


def _wall_c(draw: Draw, plan: Plan, weather: Weather) -> TemperatureField:
    """Conduction along the wall around slabs, lintels, radiators and what the wall hides."""
    surface_c = weather.air_c + 0.55 * weather.sun_c + 0.06 * (weather.indoors_c - weather.air_c)
    plate = Plate(plan.length, plan.height, draw.between(0.12, 0.2), surface_c, 0.07)
    x, z = plate.cell_centres()
    z = z + plan.height / 2
    pipe_c = weather.indoors_c + draw.between(8.0, 28.0)
    contacts = hidden_in_wall(draw, plate, weather.indoors_c, pipe_c)
    bridges = draw.between(0.05, 0.4)
    for level in range(plan.storeys + 1):
        slab = np.abs(z - 0.3 - level * plan.storey) < 0.12
        contacts.append(Contact(slab, weather.indoors_c, bridges * draw.between(0.6, 1.2)))
    for opening in plan.openings:
        above = (x > opening.left - 0.2) & (x < opening.right + 0.2)
        lintel = above & (z > opening.top) & (z < opening.top + 0.22)
        contacts.append(Contact(lintel, weather.indoors_c, draw.between(0.02, 0.35)))
        if opening.name != "door" and draw.chance(0.3) and weather.air_c < 14.0:
            niche = (
                (np.abs(x - opening.x) < 0.4 * opening.width)
                & (z < opening.z)
                & (z > opening.z - 0.6)
            )
            contacts.append(Contact(niche, pipe_c, draw.between(0.05, 0.25)))
    contacts.append(Contact(z < 0.4, weather.air_c + 4.0, draw.between(0.05, 0.3)))
    solved, inwards = solve(plate, contacts), 0.25 * (weather.indoors_c - weather.air_c)

    def celsius(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        up = points[:, 2] - plan.height / 2
        at_face = solved.at(np.stack([points[:, 0], up, up], axis=-1))
        return at_face + inwards * (points[:, 1] / plan.reveal).clip(0.0, 1.0)

    return celsius


def _walls(draw: Draw, plan: Plan, weather: Weather) -> list[Solid]:
    front = pierced_wall(plan.length, plan.height, plan.openings)
    reveals = merge([reveal(opening, plan.reveal) for opening in plan.openings])
    faces = box_faces(plan.length, plan.depth, plan.height)
    sides = merge([faces[side] for side in ("left", "right", "back")])
    rows, columns = round(70 * plan.height), round(70 * plan.length)
    texture = np.array(finishes.outside_wall(draw, rows, columns))
    if draw.chance(0.6):
        plinth = round(rows * (1.0 - draw.between(0.4, 1.0) / plan.height))
        texture[plinth:] = (0.62 * texture[plinth:]).astype(np.uint8)
    wall_c = _wall_c(draw, plan, weather)
    side = Material(finishes.outside_wall(draw, 256, 256) if draw.chance(0.4) else texture)
    return [
        Solid("wall", front, Material(texture), wall_c),
        Solid("reveals", reveals, finishes.matte(draw), wall_c),
        Solid("side_walls", sides, side, weather.facing(0.4), (0.0, plan.depth / 2, 0.0)),
    ]


def _windows(draw: Draw, plan: Plan, weather: Weather) -> list[Solid]:
    """Panes, of which one may be open or broken; frames, sills, shutters and the door."""
    solids, frames, sills, shutters = [], [], [], []
    bars = draw.whole(1, 3), draw.whole(1, 2)
    quality, shuttered = draw.between(0.12, 0.5), draw.chance(0.35)
    across = weather.indoors_c - weather.air_c
    pitch = plan.length / plan.columns
    for opening in plan.openings:
        share = quality * draw.between(0.7, 1.3)
        share = 0.9 if draw.chance(0.05) else share  # open
        cold = weather.air_c + 0.4 * weather.sun_c + share * across
        celsius = graded(cold, cold + 0.08 * across, 2, opening.z, opening.top)
        if draw.chance(0.2):
            leak = (
                (draw.one_of(opening.left, opening.right), plan.reveal, opening.top),
                0.25,
                0.35 * across,
            )
            celsius = spotted(celsius, [leak])
        if opening.name == "door":
            leaf = Material(textures.wood(128, 96, draw.whole(1, 6), draw.rng), "glossy", 0.3)
            look = leaf if draw.chance(0.5) else finishes.painted(draw)
        else:
            look = finishes.glass(draw, _interior(draw))
            frames.append(window_frame(opening, plan.reveal - 0.05, bars, 0.06))
            sills.append(
                beam(
                    opening.left - 0.08,
                    opening.right + 0.08,
                    -0.08,
                    0.05,
                    opening.z - 0.05,
                    opening.z,
                )
            )
            wide = min(0.5 * opening.width, 0.45 * (pitch - opening.width))
            shutters += [
                beam(min(a, b), max(a, b), -0.05, -0.01, opening.z, opening.top)
                for a, b in (
                    (opening.left - 0.02, opening.left - wide),
                    (opening.right + 0.02, opening.right + wide),
                )
            ]
        solids.append(Solid(f"pane_{opening.name}", pane(opening, plan.reveal), look, celsius))
    if frames:
        warm = constant(weather.air_c + 0.3 * weather.sun_c + 0.15 * across)
        solids.append(Solid("frames", merge(frames), finishes.painted(draw), warm))
        solids.append(Solid("sills", merge(sills), finishes.matte(draw), weather.facing(0.7)))
    if shuttered and shutters:
        solids.append(
            Solid("shutters", merge(shutters), finishes.household(draw), weather.facing(0.8))
        )
    return solids


def _interior(draw: Draw) -> textures.Texture:
    """A dim room behind a pane, with curtains."""
    room = textures.blend((14, 18, 26), (62, 60, 58), textures.noise(96, 96, (3, 4), draw.rng))
    cloth = np.array(draw.colour((0.0, 0.4), (0.3, 0.8)))
    share = draw.whole(0, 36)
    for column in range(share):
        tone = 0.7 + 0.3 * np.sin(0.9 * column)
        room[:, column] = room[:, 95 - column] = (tone * cloth).astype(np.uint8)
    return room


def _attached(draw: Draw, plan: Plan, weather: Weather) -> list[Solid]:
    """Balconies, units, lamps and cables on the wall."""
    solids: list[Solid] = []
    for number, opening in enumerate(draw.some(plan.openings, draw.whole(0, 3))):
        if opening.z > 2.5:
            solids += _balcony(draw, weather, f"balcony_{number}", opening)
    for number in range(draw.whole(0, 2)):
        x, z = draw.between(-0.45, 0.45) * plan.length, draw.between(0.3, plan.height - 1.4)
        if any(abs(x - o.x) < o.width / 2 + 1.1 and o.z - 1.4 < z < o.top for o in plan.openings):
            continue
        for unit in surroundings.box_unit(draw, weather, f"unit_{number}"):
            low = unit.mesh.vertices[:, 1].min()
            solids.append(
                Solid(
                    unit.name,
                    unit.mesh.placed(0.0, low, 0.0),
                    unit.material,
                    unit.temperature_c,
                    (x, -0.05, z),
                )
            )
    if draw.chance(0.5):
        x = draw.between(-0.45, 0.45) * plan.length
        cable = [rod((x, -0.03, 0.0), (x, -0.03, plan.height), 0.015, 8)]
        solids.append(
            Solid("cable", merge(cable), finishes.painted(draw, (40, 40, 42)), weather.facing(0.6))
        )
    return solids


def _balcony(draw: Draw, weather: Weather, name: str, opening: Opening) -> list[Solid]:
    """A slab that carries heat out of the house, and a railing of thin bars."""
    half, out, z = 0.5 * opening.width + 0.4, draw.between(0.7, 1.3), opening.z - 0.1
    slab = beam(opening.x - half, opening.x + half, -out, 0.0, z - 0.16, z)
    bars = [(x, -out + 0.04) for x in np.arange(-half + 0.04, half, draw.between(0.1, 0.25))]
    posts = [rod((opening.x + x, y, z), (opening.x + x, y, z + 0.95), 0.012, 6) for x, y in bars]
    posts.append(
        rod(
            (opening.x - half, -out + 0.04, z + 0.97),
            (opening.x + half, -out + 0.04, z + 0.97),
            0.025,
            8,
        )
    )
    warm = 0.3 * (weather.indoors_c - weather.air_c)
    field_c = graded(weather.air_c + 0.6 * weather.sun_c, weather.air_c + warm, 1, -0.6, 0.0)
    return [
        Solid(f"{name}_slab", slab, finishes.matte(draw, (180, 176, 168)), field_c),
        Solid(f"{name}_railing", merge(posts), finishes.household(draw), weather.facing(0.5)),
    ]


def _yard(draw: Draw, plan: Plan, weather: Weather) -> list[Solid]:
    """The ground, a car, plants and bins before the house, and neighbours behind it."""
    warm = [((draw.between(-0.4, 0.4) * plan.length, -0.2, 0.0), 0.6, draw.between(0.0, 4.0))]
    solids = [*surroundings.ground(draw, weather, warm), *surroundings.neighbours(draw, weather)]
    side = draw.one_of(-1.0, 1.0)
    if draw.chance(0.5):
        solids += surroundings.vehicle(
            draw,
            weather,
            "car",
            (-side * draw.between(0.1, 0.4) * plan.length, -draw.between(2.0, 3.5)),
            draw.one_of(0.0, 180.0) + draw.between(-15.0, 15.0),
        )
    beside = side * (plan.length / 2 + draw.between(0.8, 2.0))
    places = [
        (beside, -draw.between(0.8, 2.0)),
        (side * draw.between(0.1, 0.4) * plan.length, -0.9),
    ]
    solids += surroundings.plants(draw, weather, places[: draw.whole(0, 2)])
    if draw.chance(0.4):
        solids += surroundings.bins(draw, weather, -side * 0.42 * plan.length)
    if draw.chance(0.4):
        solids += surroundings.fence(draw, weather, "fence", (side * (plan.length / 2 + 6.2), 1.0))
    return solids
