"""The scene ``tabletop``: hot, cold and powered things on a wooden table in the corner of a room.

The origin is the centre of the table top, z up, metres. Temperatures of objects are formulas in the
object's own frame; the table's follow from steady heat conduction around their feet (see
``conduction``). Three things show in thermal images alone: the ring where the mug stood before, the
components under the electronics' lid, and the trace of a hand on the upper book.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from mrgs_synth import textures
from mrgs_synth.cameras import CameraArc
from mrgs_synth.conduction import Contact, Plate, PlateTemperature, solve
from mrgs_synth.shapes import box, box_faces, lathe, merge, sphere, tube, without
from mrgs_synth.stage import Lamp, Material, Solid, Stage, constant

AMBIENT_C = 21.0
TABLE = Plate(length_m=1.2, width_m=0.8, spread_m=0.035, ambient_c=AMBIENT_C)
TABLE_THICKNESS_M = 0.03
FLOOR_M = -0.74
CLOTH_M = 0.003

Point = tuple[float, float, float]
KETTLE: Point = (-0.24, 0.15, 0.0)
MUG: Point = (0.11, -0.16, CLOTH_M)
CLOTH: Point = (0.12, -0.18, 0.0)
CAN: Point = (0.33, 0.1, 0.0)
ICE_PLATE: Point = (0.42, -0.05, 0.0)
ELECTRONICS: Point = (-0.3, -0.17, 0.0)
BOOKS: Point = (0.1, 0.2, 0.0)
VASE: Point = (-0.46, 0.02, 0.0)
COPPER_BALL: Point = (-0.08, -0.02, 0.0)
ORANGE: Point = (0.01, -0.26, CLOTH_M)
GHOST_RING: Point = (-0.1, -0.2, 0.0)


def tabletop(seed: int) -> Stage:
    """Build the scene; the seed chooses the textures."""
    rng = np.random.default_rng([seed, 0])
    table = solve(TABLE, _contacts(TABLE))
    solids = [
        *_room(rng),
        *_table(table, rng),
        *_kettle(rng),
        *_mug(rng),
        *_can(rng),
        *_ice(rng),
        *_electronics(rng),
        *_books(rng),
        *_decoration(rng),
    ]
    return Stage(
        solids=tuple(solids),
        lamps=(
            Lamp((0.6, -0.6, 1.67), (0.6, -0.6, 0.0), (3.2, 3.2), (0.75, 0.8, 0.9)),
            Lamp((0.55, -0.75, 1.6), (0.0, 0.0, 0.0), (0.9, 0.9), (12.0, 10.6, 8.6)),
        ),
        sky=None,
        exposure=1.25,
        cameras=CameraArc(
            target=(0.0, 0.0, 0.05),
            azimuth_deg=(-145.0, 55.0),
            rings=((24.0, 1.08), (38.0, 1.0), (54.0, 0.96)),
        ),
        beyond_c=constant(AMBIENT_C),
    )


def _contacts(plate: Plate) -> list[Contact]:
    """What warms or cools the table top."""
    x, y = plate.cell_centres()

    def disc(centre: Point, radius: float) -> Bool[np.ndarray, "rows columns"]:
        return np.hypot(x - centre[0], y - centre[1]) < radius

    angle = np.radians(14.0)
    along = (x - ELECTRONICS[0]) * np.cos(angle) + (y - ELECTRONICS[1]) * np.sin(angle)
    across = (y - ELECTRONICS[1]) * np.cos(angle) - (x - ELECTRONICS[0]) * np.sin(angle)
    return [
        Contact(disc(KETTLE, 0.08), 74.0, 2.5),
        Contact(disc(MUG, 0.037), 56.0, 1.5),
        Contact(disc(CAN, 0.026), 5.0, 4.0),
        Contact(disc(ICE_PLATE, 0.045), 2.0, 3.0),
        Contact((np.abs(along) < 0.08) & (np.abs(across) < 0.055), 34.0, 0.8),
        Contact(disc(GHOST_RING, 0.04) & ~disc(GHOST_RING, 0.03), 52.0, 0.6),
    ]


def _room(rng: np.random.Generator) -> list[Solid]:
    """Floor, four walls with pictures, and a radiator; the ceiling is a lamp."""
    size, corner = 3.2, (0.6, -0.6, FLOOR_M)
    faces = box_faces(size, size, 2.4)
    palettes = [
        [(214, 120, 70), (250, 220, 160), (60, 90, 110), (150, 50, 50)],
        [(50, 96, 120), (236, 190, 90), (220, 230, 226), (190, 80, 60)],
        [(120, 150, 96), (240, 236, 210), (70, 80, 60), (230, 150, 80)],
        [(160, 120, 160), (248, 226, 200), (80, 60, 110), (240, 170, 90)],
    ]
    grounds = [(206, 214, 208), (222, 204, 176), (196, 204, 216), (216, 200, 190)]
    ornaments = [(112, 144, 138), (170, 120, 84), (104, 124, 156), (150, 110, 110)]
    solids = [
        Solid(
            "floor",
            faces["bottom"].inside_out(),
            Material(textures.parquet(1440, 12, rng)),
            _floor_c,
            corner,
        )
    ]
    for name, palette, ground, ornament in zip(
        ("back", "left", "right", "front"), palettes, grounds, ornaments, strict=True
    ):
        wall = textures.wallpaper(768, 1024, ground, ornament, 56, rng)
        for column in (280, 720):
            wall = textures.hang(
                wall, textures.geometric(190, 240, palette, 22, rng), (460, column)
            )
        solids.append(
            Solid(f"wall_{name}", faces[name].inside_out(), Material(wall), _wall_c, corner)
        )
    fins = textures.bands(64, 256, [(1.0, (226, 224, 216))], rng)
    fins[:, ::16] = fins[:, 1::16] = (120, 118, 112)
    solids.append(
        Solid(
            "radiator",
            box(0.9, 0.08, 0.55),
            Material(fins, "glossy", 0.3),
            _radiator_c,
            (1.35, 0.94, FLOOR_M + 0.12),
        )
    )
    return solids


def _floor_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Cooler towards the walls at the back and at the left."""
    from_wall = np.minimum(points[:, 0] + 1.6, 1.6 - points[:, 1])
    return 20.2 - 1.2 * np.exp(-from_wall / 0.4)


def _wall_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Warmer upwards, with thermal bridges along the vertical edges and the floor."""
    from_edge = 1.6 - np.minimum(np.abs(points[:, 0]), np.abs(points[:, 1]))
    return (
        19.6
        + 0.8 * points[:, 2]
        - 1.8 * np.exp(-from_edge / 0.15)
        - 1.0 * np.exp(-points[:, 2] / 0.12)
    )


def _radiator_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    return 31.0 + 12.0 * points[:, 2] / 0.55 - 2.0 * points[:, 0]


def _table(table: PlateTemperature, rng: np.random.Generator) -> list[Solid]:
    top = Material(textures.wood(800, 1200, 6, rng), "glossy", 0.25)
    edge = Material(textures.wood(64, 512, 1, rng))
    faces = box_faces(TABLE.length_m, TABLE.width_m, TABLE_THICKNESS_M)
    sides = without(faces, "top")
    place = (0.0, 0.0, -TABLE_THICKNESS_M)
    leg = box(0.06, 0.06, -FLOOR_M - TABLE_THICKNESS_M)
    legs = merge([leg.placed(x, y, FLOOR_M) for x in (-0.54, 0.54) for y in (-0.34, 0.34)])
    cloth = textures.weave(
        420, 560, [(190, 52, 48), (236, 226, 206)], [(236, 226, 206), (48, 84, 128)], 12
    )
    yaw = -12.0
    cos, sin = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))

    def cloth_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Thin enough to have the table's temperature."""
        x = CLOTH[0] + cos * points[:, 0] - sin * points[:, 1]
        y = CLOTH[1] + sin * points[:, 0] + cos * points[:, 1]
        return table.at(np.stack([x, y, points[:, 2]], axis=-1))

    return [
        Solid("table_top", faces["top"], top, table.at, place),
        Solid("table_sides", sides, edge, table.at, place),
        Solid("table_legs", legs, edge, constant(20.4)),
        Solid("cloth", box(0.4, 0.3, CLOTH_M), Material(cloth), cloth_c, CLOTH, yaw),
    ]


def _kettle(rng: np.random.Generator) -> list[Solid]:
    """An enamel kettle with water at 84 °C up to 0.1 m."""
    body = lathe(
        [(0.0, 0.0), (0.082, 0.0)],
        [
            (0.082, 0.0),
            (0.092, 0.012),
            (0.094, 0.04),
            (0.088, 0.08),
            (0.072, 0.115),
            (0.052, 0.135),
        ],
        [(0.052, 0.135), (0.0, 0.135)],
    )
    lid = lathe(
        [(0.0, 0.135), (0.05, 0.135)],
        [(0.05, 0.135), (0.048, 0.143), (0.03, 0.152), (0.008, 0.156)],
        [(0.008, 0.156), (0.007, 0.162), (0.015, 0.17), (0.012, 0.18), (0.0, 0.183)],
    )
    t = np.linspace(0.0, 1.0, 24)[:, None]
    start, bend, tip = (
        np.array([[0.075, 0.0, 0.055]]),
        np.array([[0.125, 0.0, 0.06]]),
        np.array([[0.14, 0.0, 0.125]]),
    )
    spout = tube((1 - t) ** 2 * start + 2 * t * (1 - t) * bend + t**2 * tip, 0.013)
    arc = np.linspace(np.radians(12.0), np.radians(168.0), 40)
    handle = tube(
        np.stack([0.068 * np.cos(arc), 0.0 * arc, 0.115 + 0.115 * np.sin(arc)], axis=-1), 0.008
    )
    blue = textures.speckles(
        textures.plain((36, 82, 132), rng, 512), (226, 234, 240), 900, 2.4, rng
    )
    blue = textures.zigzag(blue, (240, 214, 120), 0.5, 0.03, 16, 9)
    enamel, grip = (
        Material(blue, "glossy", 0.12),
        Material(textures.wood(64, 256, 1, rng, (40, 26, 18), (96, 62, 40))),
    )
    parts = {
        "body": (body, enamel, _kettle_c),
        "lid": (lid, enamel, _kettle_c),
        "spout": (spout, enamel, _kettle_c),
    }
    parts["handle"] = (handle, grip, _kettle_handle_c)
    return [
        Solid(f"kettle_{k}", mesh, look, field, KETTLE, 205.0)
        for k, (mesh, look, field) in parts.items()
    ]


def _kettle_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Warmer upwards to the water's level, cooler above it and along the spout."""
    z, out = points[:, 2], np.maximum(np.hypot(points[:, 0], points[:, 1]) - 0.094, 0.0)
    wall = (
        74.0
        + 8.0 * np.minimum(z, 0.1) / 0.1
        - 26.0 * (1.0 - np.exp(-np.maximum(z - 0.1, 0.0) / 0.04))
    )
    return AMBIENT_C + (wall - AMBIENT_C) * np.exp(-out / 0.07)


def _kettle_handle_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Warm where it is fixed to the body."""
    return 27.0 + 24.0 * np.exp(-np.maximum(points[:, 2] - 0.12, 0.0) / 0.03)


def _mug(rng: np.random.Generator) -> list[Solid]:
    """A stoneware mug with coffee up to 0.078 m."""
    body = lathe(
        [(0.0, 0.0), (0.035, 0.0)],
        [(0.035, 0.0), (0.04, 0.006), (0.042, 0.02), (0.042, 0.06), (0.042, 0.092)],
        [(0.042, 0.092), (0.0415, 0.0945), (0.04, 0.0955), (0.0385, 0.0945), (0.038, 0.092)],
        [(0.038, 0.092), (0.038, 0.01)],
        [(0.038, 0.01), (0.0, 0.01)],
    )
    coffee = lathe(
        [(0.0, 0.012), (0.0378, 0.012)],
        [(0.0378, 0.012), (0.0378, 0.078)],
        [(0.0378, 0.078), (0.0, 0.078)],
    )
    arc = np.linspace(np.radians(-80.0), np.radians(80.0), 32)
    handle = tube(
        np.stack([0.036 + 0.031 * np.cos(arc), 0.0 * arc, 0.05 + 0.027 * np.sin(arc)], axis=-1),
        0.0055,
    )
    # The profile's share of the outer wall is 0.15 to 0.52 from the bottom, which is 0.48 to 0.85
    # from the upper edge.
    cream, rust = (238, 226, 200), (186, 84, 50)
    glaze = textures.bands(
        256,
        512,
        [(0.53, cream), (0.58, rust), (0.72, cream), (0.76, rust), (1.0, (120, 70, 52))],
        rng,
    )
    glaze = textures.zigzag(glaze, (52, 96, 110), 0.65, 0.035, 10, 7)
    look = Material(glaze, "glossy", 0.15)
    drink = Material(textures.plain((66, 36, 18), rng), "glossy", 0.1)
    parts = {
        "body": (body, look, _mug_c),
        "handle": (handle, look, _mug_c),
        "coffee": (coffee, drink, _coffee_c),
    }
    return [
        Solid(f"mug_{k}", mesh, material, field, MUG, -35.0)
        for k, (mesh, material, field) in parts.items()
    ]


def _mug_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Warmest at the coffee's level, cooler towards the foot and the rim, and along the handle."""
    z, out = points[:, 2], np.maximum(np.hypot(points[:, 0], points[:, 1]) - 0.042, 0.0)
    wall = 52.0 + 8.0 * np.minimum(z, 0.078) / 0.078 - 60.0 * np.maximum(z - 0.078, 0.0) / 0.1
    return AMBIENT_C + 4.0 + (wall - AMBIENT_C - 4.0) * np.exp(-out / 0.012)


def _coffee_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    return 67.0 - 2.5 * (points[:, 0] ** 2 + points[:, 1] ** 2) / 0.038**2


def _can(rng: np.random.Generator) -> list[Solid]:
    """A cold drink, three quarters full."""
    body = lathe(
        [(0.0, 0.0), (0.025, 0.0)],
        [(0.025, 0.0), (0.033, 0.008), (0.033, 0.06), (0.033, 0.108), (0.027, 0.119)],
    )
    lid = lathe(
        [(0.027, 0.119), (0.027, 0.121), (0.025, 0.121), (0.024, 0.118)],
        [(0.024, 0.118), (0.0, 0.118)],
    )
    green, cream = (30, 132, 96), (240, 240, 228)
    label = textures.bands(
        320,
        512,
        [(0.2, green), (0.3, cream), (0.62, green), (0.68, (240, 190, 60)), (1.0, green)],
        rng,
    )
    label = textures.zigzag(label, (240, 190, 60), 0.46, 0.1, 6, 16)
    label = textures.speckles(label, cream, 60, 5.0, rng)
    tin = Material(textures.plain((214, 216, 220), rng), "metal", 0.3)
    return [
        Solid("can_body", body, Material(label, "glossy", 0.15), _can_c, CAN),
        Solid("can_lid", lid, tin, _can_c, CAN),
    ]


def _can_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Coldest at the foot; above the drink's level it warms towards the room."""
    z = points[:, 2]
    return (
        4.5
        + 2.5 * np.minimum(z, 0.085) / 0.085
        + 6.0 * (1.0 - np.exp(-np.maximum(z - 0.085, 0.0) / 0.02))
    )


def _ice(rng: np.random.Generator) -> list[Solid]:
    """Ice cubes on a small plate."""
    plate = lathe(
        [(0.0, 0.0), (0.045, 0.0)],
        [(0.045, 0.0), (0.06, 0.006), (0.075, 0.014)],
        [(0.075, 0.014), (0.0745, 0.0165)],
        [(0.0745, 0.0165), (0.06, 0.01), (0.044, 0.006)],
        [(0.044, 0.006), (0.0, 0.006)],
    )
    glaze = textures.bands(
        128, 512, [(0.36, (244, 240, 232)), (0.56, (70, 110, 160)), (1.0, (244, 240, 232))], rng
    )
    glaze = textures.zigzag(glaze, (236, 190, 90), 0.46, 0.05, 20, 4)
    cubes = [
        ((-0.017, 0.012, 0.006), 20.0),
        ((0.02, 0.004, 0.006), 65.0),
        ((-0.002, -0.024, 0.006), 40.0),
        ((0.0, 0.002, 0.034), 10.0),
    ]
    cube = merge([box(0.028, 0.028, 0.028).placed(*place, yaw) for place, yaw in cubes])
    frost = textures.blend((150, 186, 206), (240, 248, 252), textures.noise(128, 128, (6, 6), rng))
    return [
        Solid("ice_plate", plate, Material(glaze, "glossy", 0.15), _ice_plate_c, ICE_PLATE),
        Solid("ice_cubes", cube, Material(frost, "glossy", 0.2), constant(0.0), ICE_PLATE),
    ]


def _ice_plate_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    return AMBIENT_C - 19.0 * np.exp(-((np.hypot(points[:, 0], points[:, 1]) / 0.06) ** 2))


def _electronics(rng: np.random.Generator) -> list[Solid]:
    """A powered box with a hot component under its lid."""
    faces = box_faces(0.17, 0.115, 0.036)
    sides = without(faces, "top")
    lid = Material(textures.instrument_panel(240, 360, rng), "glossy", 0.25)
    ports = textures.bands(
        48, 256, [(0.25, (58, 62, 70)), (0.6, (30, 32, 36)), (1.0, (58, 62, 70))], rng
    )
    ports[14:28, 30:226:28] = ports[14:28, 31:226:28] = ports[14:28, 32:226:28] = (210, 180, 90)
    case = Material(ports, "glossy", 0.3)
    return [
        Solid("electronics_lid", faces["top"], lid, _electronics_c, ELECTRONICS, 14.0),
        Solid("electronics_case", sides, case, _electronics_c, ELECTRONICS, 14.0),
    ]


def _electronics_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    spot = (
        (points[:, 0] + 0.035) ** 2
        + (points[:, 1] - 0.015) ** 2
        + (0.5 * (points[:, 2] - 0.036)) ** 2
    )
    second = (
        (points[:, 0] - 0.045) ** 2
        + (points[:, 1] + 0.02) ** 2
        + (0.5 * (points[:, 2] - 0.036)) ** 2
    )
    return 30.0 + 26.0 * np.exp(-spot / (2 * 0.014**2)) + 9.0 * np.exp(-second / (2 * 0.02**2))


def _books(rng: np.random.Generator) -> list[Solid]:
    """Two books, the upper one turned and still a little warm from a hand."""
    solids: list[Solid] = []
    volumes = [
        (
            "lower",
            (0.24, 0.17, 0.028),
            0.0,
            8.0,
            [(150, 44, 44), (240, 190, 110), (60, 40, 60), (226, 120, 70)],
        ),
        (
            "upper",
            (0.2, 0.135, 0.022),
            0.028,
            -16.0,
            [(34, 96, 104), (240, 226, 190), (230, 140, 60), (20, 50, 70)],
        ),
    ]
    for name, size, z, yaw, palette in volumes:
        faces = box_faces(*size)
        place = (BOOKS[0], BOOKS[1], z)
        cover = Material(textures.title_page(340, 480, palette, rng), "glossy", 0.2)
        spine = Material(textures.geometric(48, 340, palette, 16, rng), "glossy", 0.2)
        edge = Material(textures.pages(48, 340, rng))
        covers, cut = (
            merge([faces["top"], faces["bottom"]]),
            merge([faces[k] for k in ("back", "left", "right")]),
        )
        field = _hand_warm_c if name == "upper" else constant(20.8)
        parts = [("cover", covers, cover), ("spine", faces["front"], spine), ("pages", cut, edge)]
        solids += [
            Solid(f"book_{name}_{part}", mesh, look, field, place, yaw)
            for part, mesh, look in parts
        ]
    return solids


def _hand_warm_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    return 20.9 + 3.5 * np.exp(
        -((points[:, 0] - 0.03) ** 2 + (points[:, 1] + 0.01) ** 2) / (2 * 0.03**2)
    )


def _decoration(rng: np.random.Generator) -> list[Solid]:
    """A vase, a copper ball and an orange, all near the room's temperature."""
    vase = lathe(
        [(0.0, 0.0), (0.04, 0.0)],
        [
            (0.04, 0.0),
            (0.055, 0.03),
            (0.06, 0.07),
            (0.05, 0.115),
            (0.03, 0.15),
            (0.024, 0.175),
            (0.032, 0.2),
        ],
        [(0.032, 0.2), (0.03, 0.202)],
        [(0.03, 0.202), (0.027, 0.198), (0.021, 0.175), (0.02, 0.15)],
        [(0.02, 0.15), (0.0, 0.15)],
    )
    teal, sand = (30, 120, 124), (230, 200, 150)
    glaze = textures.bands(
        512,
        512,
        [(0.3, teal), (0.44, sand), (0.6, teal), (0.66, sand), (0.8, teal), (1.0, sand)],
        rng,
    )
    for centre, colour in (
        (0.37, (176, 70, 52)),
        (0.52, sand),
        (0.73, (240, 170, 70)),
        (0.88, teal),
    ):
        glaze = textures.zigzag(glaze, colour, centre, 0.03, 9, 10)
    copper = textures.blend((190, 104, 70), (250, 170, 124), textures.noise(256, 512, (8, 16), rng))
    peel = textures.speckles(textures.plain((240, 140, 34), rng, 256), (196, 92, 18), 700, 1.4, rng)
    return [
        Solid("vase", vase, Material(glaze, "glossy", 0.08), constant(20.6), VASE),
        Solid(
            "copper_ball",
            sphere(0.042),
            Material(copper, "metal", 0.22),
            constant(21.6),
            COPPER_BALL,
        ),
        Solid("orange", sphere(0.037), Material(peel, "glossy", 0.3), constant(18.5), ORANGE),
    ]
