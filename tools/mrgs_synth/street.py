"""What surrounds the house of the scene ``facade``: yard, hedge, tree, car, neighbours and
hills."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw

from mrgs_synth import outdoor, textures
from mrgs_synth.building import beam, frustum, prism, rod
from mrgs_synth.outdoor import SnowCover
from mrgs_synth.shapes import Mesh, box, grid_mesh, merge, quad, tube
from mrgs_synth.stage import Material, Solid, TemperatureField, constant

YARD = ((-16.0, -24.0), (16.0, 0.0))
PATHS = (
    (0.3, 1.7, -24.0, -0.8),
    (1.7, 7.2, -6.2, -3.0),
    (5.4, 7.2, -24.0, -6.2),
)  # x from and to, y from and to
PIXELS_PER_M = 45
CAR = (4.3, -4.6, 0.0)
CAR_YAW_DEG = 172.0
TREE = (-7.7, -1.3, 0.0)


def street(rng: np.random.Generator) -> list[Solid]:
    """Everything but the house."""
    return [*_ground(rng), *_plants(rng), *_car(rng), *_bins(rng), *_neighbours(rng)]


def _ground(rng: np.random.Generator) -> list[Solid]:
    """A lawn with patches of snow, a paved path to the door and a drive, and fields as far as the
    hills."""
    (left, front), (right, back) = YARD
    shape = (round((back - front) * PIXELS_PER_M), round((right - left) * PIXELS_PER_M))
    snow = SnowCover.scattered(shape, YARD[0], YARD[1], 0.38, rng)
    image = Image.fromarray(outdoor.grass(*shape, rng))
    stones = outdoor.paving(*shape, 27, rng)
    mask = Image.new("L", (shape[1], shape[0]))
    draw = ImageDraw.Draw(mask)
    for x0, x1, y0, y1 in PATHS:
        corners = ((x0 - left, back - y1), (x1 - left, back - y0))
        draw.rectangle([(x * PIXELS_PER_M, y * PIXELS_PER_M) for x, y in corners], fill=255)
    image.paste(Image.fromarray(stones), (0, 0), mask)
    yard = quad(
        np.array([(left, front, 0.0), (right, front, 0.0), (right, back, 0.0), (left, back, 0.0)])
    )
    far = quad(
        np.array(
            [(-90.0, -90.0, -0.03), (90.0, -90.0, -0.03), (90.0, 90.0, -0.03), (-90.0, 90.0, -0.03)]
        )
    )
    fields = textures.blend(
        (128, 126, 106), (232, 236, 242), textures.noise(512, 512, (16, 16), rng)
    )

    def yard_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        x, y = points[:, 0], points[:, 1]
        paved = np.logical_or.reduce(
            [(x > x0) & (x < x1) & (y > y0) & (y < y1) for x0, x1, y0, y1 in PATHS]
        )
        beside_wall = 3.5 * np.exp(y / 0.5) * (np.abs(x) < 6.0)
        under_car = 2.5 * np.exp(
            -((np.abs(x - CAR[0]) / 2.0) ** 4) - (np.abs(y - CAR[1]) / 0.9) ** 4
        )
        return (
            -5.0 + 1.6 * paved + beside_wall + under_car - 2.4 * snow.at(x, y) * (1.0 - 0.4 * paved)
        )

    return [
        Solid("yard", yard, Material(snow.over(np.asarray(image), rng)), yard_c),
        Solid("fields", far, Material(fields), constant(-6.5)),
    ]


def _plants(rng: np.random.Generator) -> list[Solid]:
    """A clipped hedge beside the house, a lower one below its windows, and a bare tree."""
    look = Material(outdoor.leaves(256, 768, rng), infrared_lift=0.5)
    tall, low = hedge(5.6, 0.7, 1.15, rng), hedge(3.4, 0.6, 0.7, rng)
    clipped = merge([tall.placed(-9.6, -2.6, 0.0), low.placed(-3.2, -0.75, 0.0)])
    trunk, twigs = tree(rng, TREE)
    bark = Material(textures.wood(256, 128, 2, rng, (48, 38, 30), (112, 94, 76)))
    return [
        Solid("hedge", clipped, look, _hedge_c),
        Solid("tree", trunk, bark, constant(-2.2)),
        Solid("twigs", twigs, bark, constant(-4.0)),
    ]


def _hedge_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Its top cools towards the sky."""
    return -2.2 - 1.8 * points[:, 2].clip(0.0, 1.2)


def hedge(length: float, width: float, height: float, rng: np.random.Generator) -> Mesh:
    """A clipped hedge: a rounded profile along x with uneven leaves; its ends taper to the
    ground."""
    around, along = np.linspace(0.0, np.pi, 15), np.linspace(-1.0, 1.0, max(round(length * 8), 8))
    s, a = np.meshgrid(along, around, indexing="ij")
    bump = 1.0 + 0.16 * (textures.noise(len(along), len(around), (8, 4), rng) - 0.5)
    size = (1.0 - np.abs(s) ** 14) ** 0.5 * bump
    across, up = (np.sign(c) * np.abs(c) ** 0.45 * size for c in (np.cos(a), np.sin(a)))
    points = np.stack([s * length / 2, across * width / 2, up * height], axis=-1)
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True).clip(1e-12)
    uv = np.stack([a / np.pi, (s + 1.0) / 2], axis=-1)
    return grid_mesh(points, -normals, uv)


def tree(rng: np.random.Generator, foot: tuple[float, float, float]) -> tuple[Mesh, Mesh]:
    """A bare tree: trunk and boughs, and the twigs."""
    parts: list[list[Mesh]] = [[], []]

    def grow(
        start: Float[np.ndarray, "3"],
        direction: Float[np.ndarray, "3"],
        length: float,
        radius: float,
    ) -> None:
        bend = rng.normal(0.0, 0.12, 3)
        t = np.linspace(0.0, 1.0, 6)[:, None]
        path = start + length * (t * direction + t**2 * bend)
        parts[0 if radius > 0.03 else 1].append(tube(path, radius, 8))
        if radius < 0.02:
            return
        for _ in range(3):
            turned = (
                direction
                + 0.75 * rng.normal(0.0, 1.0, 3) * np.array([1.0, 1.0, 0.4])
                + np.array([0.0, 0.0, 0.25])
            )
            grow(
                path[rng.integers(3, 6)],
                turned / np.linalg.norm(turned),
                length * 0.62,
                radius * 0.55,
            )

    grow(np.array(foot), np.array([0.05, 0.0, 1.0]), 2.4, 0.13)
    return merge(parts[0]), merge(parts[1])


def _car(rng: np.random.Generator) -> list[Solid]:
    """A parked car whose engine and front tyres are still warm; its roof and windows face the cold
    sky."""
    lower, upper = (
        [(-2.1, 0.35), (2.1, 0.35), (2.15, 0.62)],
        [(2.05, 0.78), (0.95, 0.92), (-1.7, 0.96), (-2.1, 0.88)],
    )
    body = prism(np.array([*lower, *upper, (-2.15, 0.55)]), 1.7)
    cabin = frustum((2.9, 1.62), (1.65, 1.25), 0.5, -0.15).placed(-0.35, 0.0, 0.92)
    roof = box(1.6, 1.22, 0.03).placed(-0.5, 0.0, 1.42)
    tyres, hubs = [], []
    for x in (-1.35, 1.35):
        for side in (-1.0, 1.0):
            tyres.append(rod((x, side * 0.7, 0.32), (x, side * 0.88, 0.32), 0.32, 28))
            hubs.append(rod((x, side * 0.86, 0.32), (x, side * 0.89, 0.32), 0.19, 20))
    lights = [beam(2.06, 2.13, y - 0.18, y + 0.18, 0.6, 0.74) for y in (-0.6, 0.6)]
    paint = Material(textures.plain((168, 34, 34), rng), "glossy", 0.12)
    parts: dict[str, tuple[Mesh, Material, TemperatureField]] = {
        "body": (merge([body, roof]), paint, _bonnet_c),
        "cabin": (
            cabin,
            Material(textures.plain((30, 36, 44), rng), "glossy", 0.05),
            constant(-7.0),
        ),
        "tyres": (
            merge(tyres),
            Material(textures.plain((34, 34, 36), rng), infrared_lift=0.0),
            _tyre_c,
        ),
        "hubs": (
            merge(hubs),
            Material(textures.plain((190, 192, 196), rng), "metal", 0.3),
            constant(3.0),
        ),
        "lights": (
            merge(lights),
            Material(textures.plain((236, 236, 226), rng), "glossy", 0.1),
            constant(-3.0),
        ),
    }
    return [
        Solid(f"car_{k}", mesh, look, field, CAR, CAR_YAW_DEG)
        for k, (mesh, look, field) in parts.items()
    ]


def _bonnet_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Warm over the engine; the roof is as cold as clear nights make it."""
    engine = np.exp(-(((points[:, 0] - 1.5) / 0.55) ** 2) - (points[:, 1] / 0.7) ** 2)
    return -4.0 - 4.0 * (points[:, 2] > 1.3) + 17.0 * engine


def _tyre_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """The front ones have braked."""
    return np.where(points[:, 0] > 0.0, 6.0, 0.5)


def _bins(rng: np.random.Generator) -> list[Solid]:
    """Two refuse bins beside the corner of the house, and a bench under the living room's
    window."""
    bins = []
    for number, (x, colour) in enumerate(((-5.5, (40, 92, 60)), (-6.35, (44, 70, 120)))):
        texture = np.array(textures.plain(colour, rng))
        texture[40:56, 30:98] = (226, 222, 210)
        body = merge(
            [frustum((0.5, 0.5), (0.6, 0.62), 0.95), box(0.64, 0.68, 0.08).placed(0.0, 0.0, 0.95)]
        )
        look, yaw = Material(texture, "glossy", 0.3), 8.0 - 14.0 * number
        bins.append(Solid(f"bin_{number}", body, look, _bin_c, (x, -0.5, 0.0), yaw))
    seat = [beam(-0.8, 0.8, y, y + 0.1, 0.42, 0.46) for y in (-0.5, -0.36, -0.22)]
    seat += [beam(-0.8, 0.8, -0.12, -0.08, z, z + 0.1) for z in (0.56, 0.72)]
    seat += [beam(x, x + 0.08, -0.5, -0.08, 0.0, 0.42) for x in (-0.7, 0.62)]
    wood = Material(textures.wood(64, 512, 1, rng, (96, 58, 30), (186, 126, 72)))
    return [*bins, Solid("bench", merge(seat), wood, constant(-2.8), (3.6, 0.0, 0.0))]


def _bin_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    return -2.0 - 2.5 * (points[:, 2] > 0.97)


def _neighbours(rng: np.random.Generator) -> list[Solid]:
    """Two houses further away, a garden fence, and wooded hills all around."""
    solids = []
    house = prism(np.array([(-5.0, 0.0), (5.0, 0.0), (5.0, 5.2), (0.0, 8.4), (-5.0, 5.2)]), 11.0)
    houses = (
        ((-21.0, 9.0, 0.0), 24.0, (206, 182, 160)),
        ((20.5, 8.0, 0.0), -20.0, (176, 190, 186)),
    )
    for number, (place, yaw, colour) in enumerate(houses):
        look = Material(_far_front(colour, rng))
        solids.append(Solid(f"neighbour_{number}", house, look, _neighbour_c, place, yaw))
    posts = [
        beam(x, x + 0.12, -0.02, 0.02, 0.0, 1.05 + 0.06 * np.sin(9.0 * x))
        for x in np.arange(-7.0, 7.0, 0.21)
    ]
    rails = [beam(-7.0, 7.0, 0.02, 0.06, z, z + 0.09) for z in (0.3, 0.8)]
    picket = Material(textures.wood(128, 128, 2, rng, (150, 140, 126), (226, 220, 206)))
    for number, x in enumerate((-13.4, 13.2)):
        solids.append(
            Solid(f"fence_{number}", merge(posts + rails), picket, constant(-4.6), (x, 1.2, 0.0))
        )
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    forest = textures.blend((38, 46, 44), (108, 112, 108), textures.noise(128, 1536, (8, 160), rng))
    return [*solids, Solid("hills", hills(angle, rng), Material(forest), constant(-8.0))]


def _neighbour_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    return -1.0 + 2.0 * np.exp(-(((points[:, 2] - 2.8) / 0.25) ** 2)) - 5.0 * (points[:, 2] > 5.3)


def _far_front(colour: textures.Colour, rng: np.random.Generator) -> textures.Texture:
    """A gable end with windows."""
    image = Image.fromarray(outdoor.plaster(336, 400, colour, rng))
    draw = ImageDraw.Draw(image)
    for top in (110, 230):
        for x in (60, 180, 300):
            draw.rectangle((x - 6, top - 6, x + 46, top + 62), fill=(232, 228, 220))
            draw.rectangle((x, top, x + 40, top + 56), fill=(44, 50, 60))
            draw.line((x + 20, top, x + 20, top + 56), fill=(232, 228, 220), width=4)
    return np.asarray(image)


def hills(angle: Float[np.ndarray, " n"], rng: np.random.Generator) -> Mesh:
    """A ring of hills seen from within it."""
    bumps = np.array(
        [
            rng.uniform(0.2, 0.7) * np.cos(k * angle + rng.uniform(0.0, 6.28))
            for k in (2, 3, 5, 9, 17)
        ]
    )
    tops = 5.5 + bumps.sum(axis=0)
    ring = 75.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    low = np.concatenate([ring, np.full((len(angle), 1), -0.1)], axis=1)
    high = np.concatenate([1.1 * ring, tops[:, None]], axis=1)
    normals = np.concatenate([-ring / 75.0, np.zeros((len(angle), 1))], axis=1)
    uv = np.stack([np.stack([angle / (2 * np.pi), 0 * angle + v], axis=-1) for v in (0.0, 1.0)])
    return grid_mesh(
        np.stack([low, high])[:, ::-1], np.stack([normals, normals])[:, ::-1], uv[:, ::-1]
    )
