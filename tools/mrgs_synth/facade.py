"""The scene ``facade``: the front of a house on a clear winter morning before sunrise, as in an
energy audit.

The wall's face is the plane y = 0, x to the right, z up from the ground, metres; the cameras stand
at negative y. The temperatures of the wall follow from steady heat conduction along it (see
``conduction``) around what conducts more heat than the insulated wall does. Much of it shows in
thermal images alone: the ends of the floor slab, lintels, a heating pipe in the wall, a field that
was never insulated, the thin wall behind a radiator, the anchors of the insulation, and a damp
corner.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from PIL import Image, ImageDraw, ImageFont

from mrgs_synth import outdoor, textures
from mrgs_synth.building import Opening, beam, pane, pierced_wall, reveal, rod, window_frame
from mrgs_synth.cameras import CameraArc
from mrgs_synth.conduction import Contact, Plate, PlateTemperature, solve
from mrgs_synth.outdoor import SnowCover
from mrgs_synth.shapes import box_faces, merge, quad
from mrgs_synth.stage import Material, Solid, Stage, TemperatureField, constant
from mrgs_synth.street import street

AIR_C = -3.0
INDOORS_C = 20.0
WALL = Plate(length_m=12.0, width_m=7.0, spread_m=0.16, ambient_c=0.4, cell_m=0.04)
DEPTH_M = 8.0
SLAB_M = 2.95
REVEAL_M = 0.14
PIXELS_PER_M = 150

WINDOWS = {  # and the panes along x and z, and the temperature of the glass in °C
    Opening("kitchen", -4.3, 0.95, 1.4, 1.45): ((2, 1), 7.0),
    Opening("hall", -1.7, 0.95, 1.1, 1.45): ((2, 2), 6.2),
    Opening("living_room", 3.7, 0.8, 2.4, 1.6): ((3, 1), 8.6),
    Opening("bedroom", -4.3, 3.95, 1.4, 1.4): ((2, 1), 6.0),
    Opening("bathroom", -1.7, 3.95, 1.1, 1.4): ((2, 1), 9.6),
    Opening("balcony_door", 1.3, 3.12, 1.1, 2.23): ((1, 2), 7.6),
    Opening("study", 4.3, 3.95, 1.4, 1.4): ((2, 1), 6.6),
}
DOOR = Opening("door", 1.0, 0.16, 1.15, 2.2)
OPENINGS = (*WINDOWS, DOOR)
BALCONY = (-0.1, 2.7, 1.25)  # left, right, how far it stands out


def facade(seed: int) -> Stage:
    """Build the scene; the seed chooses the textures and where snow lies."""
    rng = np.random.default_rng([seed, 0])
    wall = solve(WALL, _contacts(WALL))
    return Stage(
        solids=(
            *_walls(wall, rng),
            *_windows(rng),
            *_door(rng),
            *_balcony(rng),
            *_roof(rng),
            *street(rng),
        ),
        lamps=(),
        sky=outdoor.clear_sky((215.0, 32.0), rng),
        exposure=1.0,
        cameras=CameraArc(
            target=(0.0, 0.0, 3.3),
            azimuth_deg=(-140.0, -40.0),
            rings=((-6.0, 13.5), (4.0, 18.5), (-8.0, 9.5), (16.0, 13.0)),
            jitter_m=0.25,
        ),
        beyond_c=sky_c,
        point_noise_m=0.015,
    )


def sky_c(directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """A clear sky: the air above the horizon, colder upwards where the path through the air is
    shorter."""
    return -31.0 + 12.0 * np.exp(-directions[:, 2].clip(0.0, 1.0) / 0.12)


def _contacts(plate: Plate) -> list[Contact]:
    """What conducts heat through the wall better than its insulation, or cools it from outside."""
    x, z = plate.cell_centres()
    z = z + plate.width_m / 2

    def area(
        left: float, right: float, bottom: float, top: float
    ) -> Bool[np.ndarray, "rows columns"]:
        return (x > left) & (x < right) & (z > bottom) & (z < top)

    lintels = np.logical_or.reduce(
        [area(o.left - 0.25, o.right + 0.25, o.top, o.top + 0.24) for o in OPENINGS]
    )
    joints = np.logical_or.reduce(
        [area(o.left - 0.07, o.right + 0.07, o.z - 0.07, o.top + 0.07) for o in OPENINGS]
    )
    anchors = (
        (np.hypot((x + 0.3) % 0.6 - 0.3, (z - 3.3) % 0.5 - 0.25) < 0.07) & (z > 3.3) & (z < 6.6)
    )
    gap = area(-3.45, -2.55, 4.3, 6.2) | area(-3.1, -2.55, 6.2, 6.6)
    left, right, _ = BALCONY
    return [
        Contact(area(-6.0, 6.0, SLAB_M - 0.12, SLAB_M + 0.12), INDOORS_C, 0.4),
        Contact(area(left, right, SLAB_M - 0.12, SLAB_M + 0.12), INDOORS_C, 0.7),
        Contact(lintels, INDOORS_C, 0.3),
        Contact(joints, 9.0, 0.35),
        Contact(gap, INDOORS_C, 0.4),
        Contact(area(-4.9, -3.7, 0.4, 0.9), 34.0, 0.22),
        Contact(area(-0.5, -0.42, 0.3, 5.0) | area(-0.5, 0.2, 4.96, 5.04), 42.0, 0.45),
        Contact(anchors, INDOORS_C, 0.3),
        Contact(area(-6.0, 6.0, 0.0, 0.4), 9.0, 0.25),
        Contact(area(5.45, 6.0, 0.0, 1.5) & (z < 0.4 + 2.0 * (x - 5.45)), -4.0, 0.7),
        Contact(area(-6.0, -5.75, 0.0, 7.0) | area(5.75, 6.0, 0.0, 7.0), AIR_C, 0.35),
        Contact(area(-6.0, 6.0, 6.7, 7.0), 8.0, 0.2),
    ]


def _wall_c(wall: PlateTemperature) -> TemperatureField:
    """The wall's temperature at its face and in its reveals, warmer upwards where eaves hide the
    cold sky."""

    def field(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        x, z = points[:, 0], points[:, 2] - WALL.width_m / 2
        inwards = 12.0 * points[:, 1].clip(0.0, REVEAL_M)
        return (
            wall.at(np.stack([x, z, z], axis=-1))
            + 0.7 * np.exp((points[:, 2] - 7.0) / 0.9)
            + inwards
        )

    return field


def _walls(wall: PlateTemperature, rng: np.random.Generator) -> list[Solid]:
    """The front with its openings, and the other walls."""
    front = pierced_wall(WALL.length_m, WALL.width_m, OPENINGS)
    reveals = merge([reveal(opening, REVEAL_M) for opening in OPENINGS])
    faces = box_faces(WALL.length_m, DEPTH_M, WALL.width_m)
    sides = merge([faces["left"], faces["right"], faces["back"]])
    gables = [
        quad(
            np.array(
                [
                    (s * 6.0, s * -4.0, 7.0),
                    (s * 6.0, s * 4.0, 7.0),
                    (s * 6.0, 0.0, 9.6),
                    (s * 6.0, 0.0, 9.6),
                ]
            )
        )
        for s in (1.0, -1.0)
    ]
    side = Material(_masonry(1050, 1200, rng))
    place = (0.0, DEPTH_M / 2, 0.0)

    def side_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        slab = np.exp(-(((points[:, 2] - SLAB_M) / 0.2) ** 2))
        return 0.4 + 1.6 * slab + 1.5 * np.exp(-points[:, 2] / 0.4)

    return [
        Solid("wall", front, Material(_paint_front(rng)), _wall_c(wall)),
        Solid("reveals", reveals, Material(textures.plain((214, 204, 186), rng)), _wall_c(wall)),
        Solid("side_walls", sides, side, side_c, place),
        Solid("gables", merge(gables), Material(textures.wood(400, 600, 14, rng)), side_c, place),
    ]


def _masonry(height: int, width: int, rng: np.random.Generator) -> textures.Texture:
    """Bricks below the floor slab, a stone band along it, render above."""
    band = round(height * (1.0 - SLAB_M / WALL.width_m))
    upper = outdoor.plaster(band, width, (226, 206, 164), rng)
    lower = outdoor.bricks(height - band, width, (16, 44), rng)
    image = Image.fromarray(np.concatenate([upper, lower]))
    draw = ImageDraw.Draw(image)
    for top, bottom, tone in (
        (band - 16, band + 16, 196),
        (band - 20, band - 16, 120),
        (band + 16, band + 20, 84),
    ):
        draw.rectangle((0, top, width, bottom), fill=(tone, tone - 6, tone - 18))
    return np.asarray(image)


def _paint_front(rng: np.random.Generator) -> textures.Texture:
    """Masonry with a plinth, corner stones, stone surrounds, painted ornaments and the house's
    number."""
    height, width = round(WALL.width_m * PIXELS_PER_M), round(WALL.length_m * PIXELS_PER_M)
    image = Image.fromarray(_masonry(height, width, rng))
    draw = ImageDraw.Draw(image)

    def stone(left: float, right: float, bottom: float, top: float) -> None:
        tone = int(rng.uniform(158, 212))
        upper_left = ((left + 6.0) * PIXELS_PER_M, (7.0 - top) * PIXELS_PER_M)
        lower_right = ((right + 6.0) * PIXELS_PER_M - 2, (7.0 - bottom) * PIXELS_PER_M - 2)
        draw.rectangle(
            (upper_left, lower_right), fill=(tone, tone - 8, tone - 24), outline=(92, 86, 76)
        )

    for course in range(23):
        long, short = (0.55, 0.32) if course % 2 else (0.32, 0.55)
        stone(-6.0, -6.0 + long, 0.3 * course + 0.1, 0.3 * course + 0.4)
        stone(6.0 - short, 6.0, 0.3 * course + 0.1, 0.3 * course + 0.4)
    for opening in OPENINGS:
        for z in np.arange(opening.z, opening.top - 0.05, 0.2):
            stone(opening.left - 0.16, opening.left, z, min(z + 0.2, opening.top))
            stone(opening.right, opening.right + 0.16, z, min(z + 0.2, opening.top))
        for x in np.linspace(opening.left - 0.16, opening.right + 0.16, 7)[:-1]:
            stone(x, x + (opening.width + 0.32) / 6, opening.top, opening.top + 0.22)
    for x in np.arange(-6.0, 6.0, 0.6):
        stone(x, x + 0.6, 0.0, 0.4)
    for x in np.arange(-5.2, 5.3, 0.65):
        place, size = ((x + 6.0) * PIXELS_PER_M, 0.62 * PIXELS_PER_M), 0.17 * PIXELS_PER_M
        draw.regular_polygon((*place, size), 4, 45, fill=(146, 74, 52), outline=(84, 60, 50))
        draw.regular_polygon((*place, size * 0.45), 6, 0, fill=(230, 196, 120))
    draw.text(
        (8.0 * PIXELS_PER_M, 5.1 * PIXELS_PER_M), "27", (30, 44, 90), ImageFont.load_default(64)
    )
    return np.asarray(image)


def _windows(rng: np.random.Generator) -> list[Solid]:
    """Glass, wooden frames, stone sills, and shutters beside the upper windows."""
    solids = []
    frames, sills, shutters = [], [], []
    for opening, (bars, glass_c) in WINDOWS.items():
        frames.append(window_frame(opening, REVEAL_M - 0.05, bars))
        if opening.name != "balcony_door":
            sills.append(
                beam(
                    opening.left - 0.1, opening.right + 0.1, -0.09, 0.1, opening.z - 0.06, opening.z
                )
            )
        if opening.name in ("bedroom", "bathroom", "study"):
            for edge, side in ((opening.left, -1.0), (opening.right, 1.0)):
                centre = edge + side * (0.18 + opening.width / 4)
                half = opening.width / 4 - 0.02
                shutters.append(
                    beam(centre - half, centre + half, -0.07, -0.02, opening.z, opening.top)
                )
        look = Material(_interior(opening, rng), "glossy", 0.05)
        solids.append(
            Solid(
                f"glass_{opening.name}", pane(opening, REVEAL_M), look, _glass_c(opening, glass_c)
            )
        )
    white = Material(textures.plain((236, 234, 226), rng), "glossy", 0.3)
    green = Material(_slats(rng), "glossy", 0.4)
    stone = Material(textures.plain((176, 170, 160), rng))
    return [
        *solids,
        Solid("frames", merge(frames), white, constant(3.4)),
        Solid("sills", merge(sills), stone, constant(0.2)),
        Solid("shutters", merge(shutters), green, constant(-1.6)),
    ]


def _glass_c(opening: Opening, celsius: float) -> TemperatureField:
    """Colder along the spacer at the edge and at the bottom; the bathroom's window leaks warm air
    at its top."""

    def field(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        x, z = points[:, 0], points[:, 2]
        edge = np.minimum(
            np.minimum(x - opening.left, opening.right - x),
            np.minimum(z - opening.z, opening.top - z),
        )
        leak = 4.5 * np.exp(-(opening.top - z) / 0.2) if opening.name == "bathroom" else 0.0
        return (
            celsius
            - 2.2 * np.exp(-(edge - 0.08).clip(0.0) / 0.06)
            + 1.4 * (z - opening.z) / opening.height
            + leak
        )

    return field


def _interior(opening: Opening, rng: np.random.Generator) -> textures.Texture:
    """What is seen through a window: a dim room, curtains, a lamp or plants on the sill."""
    height, width = round(opening.height * 200), round(opening.width * 200)
    image = Image.fromarray(
        textures.blend((16, 20, 28), (54, 52, 50), textures.noise(height, width, (3, 4), rng))
    )
    draw = ImageDraw.Draw(image)
    cloth = [(214, 208, 192), (168, 92, 74), (120, 140, 160), (206, 180, 120)][rng.integers(4)]
    for share in np.linspace(0.0, 0.26, 9):
        tone = rng.uniform(0.45, 0.8)
        colour = (int(cloth[0] * tone), int(cloth[1] * tone), int(cloth[2] * tone))
        for x in (share * width, (0.97 - share) * width):
            draw.rectangle((x, 0, x + 0.03 * width, height), fill=colour)
    for x in rng.uniform(0.32, 0.66, 2) * width:
        draw.rectangle((x - 14, height - 44, x + 14, height), fill=(150, 80, 56))
        for _ in range(26):
            dx, dy, green = rng.normal(0, 18), rng.normal(-74, 20), int(rng.uniform(70, 130))
            draw.ellipse(
                (x + dx - 7, height + dy - 5, x + dx + 7, height + dy + 5), fill=(44, green, 50)
            )
    return np.asarray(image)


def _slats(rng: np.random.Generator) -> textures.Texture:
    """A wooden shutter with louvres."""
    texture = np.array(textures.plain((46, 104, 84), rng, 160))
    texture[12:148:8, 14:146] = texture[13:148:8, 14:146] = (18, 46, 40)
    return texture


def _door(rng: np.random.Generator) -> list[Solid]:
    """A panelled door that leaks at its edges, two steps and a lamp beside it."""
    left, right, leaf = DOOR.left, DOOR.right, pane(DOOR, 0.1)
    image = Image.fromarray(textures.wood(440, 230, 1, rng, (74, 32, 24), (150, 74, 46)))
    draw = ImageDraw.Draw(image)
    for top in (40, 170, 300):
        for x in (26, 126):
            draw.rectangle((x, top, x + 78, top + 108), outline=(40, 20, 16), width=6)
    draw.rectangle((52, 54, 178, 140), fill=(40, 50, 60), outline=(220, 190, 110), width=5)
    draw.ellipse((200, 226, 220, 246), fill=(226, 196, 110))

    def leaf_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        edge = np.minimum(
            np.minimum(points[:, 0] - left, right - points[:, 0]), DOOR.top - points[:, 2]
        )
        sill = np.exp(-(points[:, 2] - DOOR.z) / 0.08)
        return 3.0 + 3.0 * np.exp(-edge.clip(0.0) / 0.05) + 5.0 * sill

    landing = beam(left - 0.3, right + 0.3, -0.4, 0.0, 0.0, 0.16)
    step = beam(left - 0.5, right + 0.5, -0.8, -0.4, 0.0, 0.08)
    glow = [(0.2, (40, 40, 44)), (0.85, (246, 232, 190)), (1.0, (40, 40, 44))]
    lamp = beam(right + 0.3, right + 0.46, -0.16, 0.0, 1.9, 2.15)
    vent = beam(2.05, 2.25, -0.05, 0.0, 2.45, 2.65)
    return [
        Solid("door", leaf, Material(np.asarray(image), "glossy", 0.2), leaf_c),
        Solid(
            "steps",
            merge([landing, step]),
            Material(outdoor.paving(256, 256, 64, rng)),
            constant(-0.8),
        ),
        Solid(
            "door_lamp",
            lamp,
            Material(textures.bands(64, 64, glow, rng), "glossy", 0.2),
            constant(11.0),
        ),
        Solid("vent", vent, Material(_slats(rng)[:, :, ::-1]), constant(13.0)),
    ]


def _balcony(rng: np.random.Generator) -> list[Solid]:
    """A concrete slab that carries heat out of the house, and an iron railing with flower boxes."""
    left, right, out = BALCONY
    slab = beam(left, right, -out, 0.0, SLAB_M - 0.1, SLAB_M + 0.1)
    places = [(x, -out + 0.05) for x in np.arange(left + 0.05, right, 0.16)]
    places += [
        (x, y) for x in (left + 0.05, right - 0.05) for y in np.arange(-out + 0.2, 0.0, 0.16)
    ]
    posts = [rod((x, y, SLAB_M + 0.1), (x, y, SLAB_M + 1.05), 0.014) for x, y in places]
    ends = [
        (left, right, -out + 0.08),
        (left + 0.02, left + 0.08, 0.0),
        (right - 0.08, right - 0.02, 0.0),
    ]
    rails = [beam(x0, x1, -out + 0.02, y, SLAB_M + 1.02, SLAB_M + 1.08) for x0, x1, y in ends]
    boxes = [
        beam(x, x + 0.7, -out - 0.18, -out + 0.02, SLAB_M + 0.72, SLAB_M + 0.92) for x in (0.2, 1.6)
    ]

    def slab_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        sheltered = 1.2 * (points[:, 2] < SLAB_M)
        return -3.2 + sheltered + 7.2 * np.exp(points[:, 1] / 0.35)

    concrete = Material(outdoor.plaster(128, 512, (186, 182, 174), rng))
    iron = Material(textures.plain((40, 42, 46), rng), "glossy", 0.3)
    return [
        Solid("balcony_slab", slab, concrete, slab_c),
        Solid("railing", merge(posts + rails), iron, constant(-4.2)),
        Solid(
            "flower_boxes", merge(boxes), Material(textures.wood(64, 256, 2, rng)), constant(-3.4)
        ),
    ]


def _roof(rng: np.random.Generator) -> list[Solid]:
    """Tiles with snow, warmer over badly insulated rafters and around the chimney, eaves, gutter
    and downpipe."""
    eaves, ridge, half = (-0.65, 6.85), (DEPTH_M / 2, 9.75), 6.4
    snow = SnowCover.scattered((560, 1280), (-half, eaves[0]), (half, ridge[0]), 0.42, rng)
    front = quad(np.array([(-half, *eaves), (half, *eaves), (half, *ridge), (-half, *ridge)]))
    back = quad(
        np.array([(half, 8.65, 6.85), (-half, 8.65, 6.85), (-half, *ridge), (half, *ridge)])
    )
    soffit = quad(
        np.array(
            [(-half, 0.0, 6.99), (half, 0.0, 6.99), (half, eaves[0], 6.8), (-half, eaves[0], 6.8)]
        )
    )
    fascia = beam(-half, half, eaves[0] - 0.02, eaves[0] + 0.02, 6.72, 6.88)
    gutter = rod((-half, -0.75, 6.8), (half, -0.75, 6.8), 0.08)
    pipe = [
        rod((5.6, -0.75, 6.76), (5.6, -0.12, 6.3), 0.05),
        rod((5.6, -0.12, 6.3), (5.6, -0.12, 0.0), 0.05),
    ]
    chimney = beam(-2.9, -2.1, 2.4, 3.2, 7.8, 10.6)

    def tiles_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        rafters = 0.9 * np.cos(2.0 * np.pi * points[:, 0] / 0.8)
        warm = 5.0 * np.exp(-np.hypot(points[:, 0] + 2.5, points[:, 1] - 2.4) / 0.6)
        return -7.5 + rafters + warm - 2.5 * snow.at(points[:, 0], points[:, 1])

    zinc = Material(textures.plain((150, 154, 160), rng), "metal", 0.35)
    wood = Material(textures.wood(96, 1024, 6, rng, (110, 84, 60), (190, 158, 120)))
    return [
        Solid(
            "roof", front, Material(snow.over(outdoor.roof_tiles(560, 1280, 20, rng), rng)), tiles_c
        ),
        Solid("roof_back", back, Material(outdoor.roof_tiles(560, 1280, 20, rng)), constant(-7.0)),
        Solid("eaves", merge([soffit, fascia]), wood, constant(-0.6)),
        Solid("gutter", merge([gutter, *pipe]), zinc, constant(-4.0)),
        Solid("chimney", chimney, Material(outdoor.bricks(420, 140, (14, 40), rng)), _chimney_c),
    ]


def _chimney_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    return 2.0 + 9.0 * (points[:, 2] - 7.8) / 2.8
