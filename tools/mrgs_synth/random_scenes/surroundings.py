"""What lies around random outdoor scenes: ground, plants, vehicles, fences, neighbours, hills."""

from __future__ import annotations

from functools import partial

import numpy as np
from jaxtyping import Float

from mrgs_synth import outdoor, textures
from mrgs_synth.building import beam, frustum, prism, rod
from mrgs_synth.outdoor import SnowCover
from mrgs_synth.random_scenes import finishes
from mrgs_synth.random_scenes.draw import Draw
from mrgs_synth.random_scenes.fields import Spot, spotted
from mrgs_synth.random_scenes.weather import Weather
from mrgs_synth.shapes import Mesh, box, merge, quad
from mrgs_synth.stage import Material, Solid, constant
from mrgs_synth.street import hedge, hills, tree

GROUND_M = 24.0


def ground(draw: Draw, weather: Weather, warm: list[Spot]) -> list[Solid]:
    """Lawn, paving, asphalt or gravel, with snow if it is cold enough, to the hills."""
    size = 900
    texture = draw.one_of(
        partial(outdoor.grass, size, size, draw.rng),
        partial(outdoor.paving, size, size, draw.whole(8, 20), draw.rng),
        partial(finishes.concrete, draw, size),
    )()
    corners = ((-GROUND_M, -GROUND_M), (GROUND_M, GROUND_M))
    amount = draw.between(0.1, 0.7) if weather.air_c < 2.0 and draw.chance(0.6) else 0.0
    snow = SnowCover.scattered((size, size), *corners, max(amount, 0.01), draw.rng)
    base = spotted(weather.facing(0.8), warm)

    def celsius(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        mottled = np.sin(1.3 * points[:, 0]) * np.cos(0.9 * points[:, 1])
        cold = 1.5 * snow.at(points[:, 0], points[:, 1]) if amount else 0.0
        return base(points) + 0.08 * weather.sun_c * mottled - cold

    near, far = _square(GROUND_M, 0.0), _square(90.0, -0.03)
    look = Material(snow.over(texture, draw.rng) if amount else texture)
    field = textures.blend(
        (110, 116, 86), (176, 172, 140), textures.noise(256, 256, (16, 16), draw.rng)
    )
    angle = np.linspace(0.0, 2.0 * np.pi, 91)
    forest = textures.blend(
        (38, 50, 40), (116, 122, 108), textures.noise(64, 768, (6, 120), draw.rng)
    )
    return [
        Solid("ground", near, look, celsius),
        Solid("fields", far, Material(field), weather.facing(0.6)),
        Solid("hills", hills(angle, draw.rng), Material(forest), weather.facing(0.3)),
    ]


def _square(half: float, z: float) -> Mesh:
    return quad(np.array([(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)]))


def plants(draw: Draw, weather: Weather, places: list[tuple[float, float]]) -> list[Solid]:
    """Hedges and bare trees at some of the places."""
    solids = []
    for number, (x, y) in enumerate(places):
        if draw.chance(0.5):
            tall = draw.between(0.5, 1.4)
            clipped = hedge(draw.between(1.5, 4.5), draw.between(0.5, 0.8), tall, draw.rng)
            look = Material(outdoor.leaves(128, 384, draw.rng), infrared_lift=0.5)
            solids.append(
                Solid(
                    f"hedge_{number}",
                    clipped,
                    look,
                    weather.facing(0.15),
                    (x, y, 0.0),
                    draw.one_of(0.0, 90.0),
                )
            )
        else:
            trunk, twigs = tree(draw.rng, (x, y, 0.0))
            bark = Material(textures.wood(128, 64, 2, draw.rng, (48, 38, 30), (112, 94, 76)))
            solids += [
                Solid(f"tree_{number}", trunk, bark, weather.facing(0.4)),
                Solid(f"twigs_{number}", twigs, bark, weather.facing(0.1)),
            ]
    return solids


def vehicle(
    draw: Draw, weather: Weather, name: str, place: tuple[float, float], yaw_deg: float
) -> list[Solid]:
    """A car or a van whose engine and brakes may be warm."""
    size, tall = draw.between(0.85, 1.25), draw.between(0.9, 1.4)
    lower = [(-2.1, 0.35), (2.1, 0.35), (2.15, 0.62)]
    upper = [(2.05, 0.78), (0.95, 0.92), (-1.7, 0.96), (-2.1, 0.88), (-2.15, 0.55)]
    body = prism(size * np.array(lower + upper), 1.7 * size)
    cabin = frustum((2.9 * size, 1.62 * size), (1.75 * size, 1.3 * size), 0.5 * tall, -0.15)
    roof = box(1.7 * size, 1.26 * size, 0.03).placed(-0.5 * size, 0.0, 0.92 * size + 0.5 * tall)
    tyres = [
        rod((x * size, s * 0.7 * size, 0.32), (x * size, s * 0.88 * size, 0.32), 0.32, 24)
        for x in (-1.35, 1.35)
        for s in (-1.0, 1.0)
    ]
    hubs = [
        rod((x * size, s * 0.86 * size, 0.32), (x * size, s * 0.9 * size, 0.32), 0.19, 18)
        for x in (-1.35, 1.35)
        for s in (-1.0, 1.0)
    ]
    rise = draw.one_of(0.0, 8.0, 22.0)
    engine = [((1.5 * size, 0.0, 0.8 * size), 0.45, rise)]
    brake = [((1.35 * size, s * 0.85, 0.32), 0.2, 1.2 * rise) for s in (-1.0, 1.0)]
    parts = {
        "body": (merge([body, roof]), finishes.painted(draw), spotted(weather.facing(0.9), engine)),
        "cabin": (
            cabin.placed(-0.35 * size, 0.0, 0.92 * size),
            finishes.glass(draw),
            weather.facing(1.1),
        ),
        "tyres": (
            merge(tyres),
            finishes.matte(draw, (34, 34, 36)),
            spotted(weather.facing(0.5), brake),
        ),
        "hubs": (merge(hubs), finishes.bare_metal(draw), spotted(weather.facing(0.5), brake)),
    }
    return [
        Solid(f"{name}_{part}", mesh, look, field, (*place, 0.0), yaw_deg)
        for part, (mesh, look, field) in parts.items()
    ]


def fence(draw: Draw, weather: Weather, name: str, place: tuple[float, float]) -> list[Solid]:
    """Thin posts and rails."""
    half = draw.between(2.0, 6.0)
    posts = [beam(x, x + 0.08, -0.02, 0.02, 0.0, 1.05) for x in np.arange(-half, half, 0.25)]
    rails = [beam(-half, half, 0.02, 0.06, z, z + 0.08) for z in (0.3, 0.8)]
    look = finishes.household(draw)
    return [Solid(name, merge([*posts, *rails]), look, weather.facing(0.4), (*place, 0.0))]


def neighbours(draw: Draw, weather: Weather) -> list[Solid]:
    """Plain houses further away, behind the scene."""
    solids = []
    for number in range(draw.whole(1, 3)):
        wide, tall = draw.between(3.5, 6.0), draw.between(3.0, 8.0)
        outline = [
            (-wide, 0.0),
            (wide, 0.0),
            (wide, tall),
            (0.0, tall + draw.between(0.3, 4.0)),
            (-wide, tall),
        ]
        house = prism(np.array(outline), draw.between(8.0, 12.0))
        x = (-1.0, 1.0, 0.15)[number] * draw.between(19.0, 26.0)
        look = Material(finishes.outside_wall(draw, 256, 256))
        celsius = spotted(
            weather.facing(0.4), [((0.0, 0.0, 0.5 * tall), 2.0, draw.between(0.0, 2.5))]
        )
        solids.append(
            Solid(
                f"neighbour_{number}",
                house,
                look,
                celsius,
                (x, draw.between(16.0, 24.0), 0.0),
                draw.between(-40.0, 40.0),
            )
        )
    return solids


def bins(draw: Draw, weather: Weather, x: float) -> list[Solid]:
    """Refuse bins at a wall whose face is y = 0."""
    solids = []
    for number in range(draw.whole(1, 3)):
        body = merge(
            [frustum((0.5, 0.5), (0.6, 0.62), 0.95), box(0.64, 0.68, 0.08).placed(0.0, 0.0, 0.95)]
        )
        solids.append(
            Solid(
                f"bin_{number}",
                body,
                finishes.painted(draw),
                weather.facing(0.5),
                (x + 0.8 * number, -0.6, 0.0),
                draw.between(-12.0, 12.0),
            )
        )
    return solids


def box_unit(draw: Draw, weather: Weather, name: str) -> list[Solid]:
    """A cooling or heating unit: a box with a fan, warm or cold where the air leaves it."""
    length, width, height = draw.between(0.6, 1.8), draw.between(0.35, 1.2), draw.between(0.5, 1.2)
    rise = draw.one_of(-6.0, 3.0, 10.0, 22.0)
    fan = rod((0.0, 0.0, height), (0.0, 0.0, height + 0.06), 0.4 * min(length, width), 28)
    front = rod(
        (0.0, -width / 2 - 0.03, height / 2), (0.0, -width / 2, height / 2), 0.35 * height, 28
    )
    shell = spotted(weather.facing(0.7), [((0.3 * length, 0.0, 0.5 * height), 0.3, 0.4 * rise)])
    out = constant(weather.air_c + rise)
    look = finishes.painted(draw, draw.colour((0.0, 0.15), (0.6, 0.95)))
    return [
        Solid(f"{name}_case", box(length, width, height), look, shell),
        Solid(f"{name}_fan", merge([fan, front]), finishes.painted(draw, (60, 62, 66)), out),
    ]
