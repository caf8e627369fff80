"""Parts on the board of the scene ``electronics``: packages, a regulator, capacitors, coils and
connectors.

All but the round parts are made in world coordinates, whose origin lies on the bench mat below the
board's centre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mrgs_synth import circuit, textures
from mrgs_synth.building import beam, rod
from mrgs_synth.circuit import Footprint
from mrgs_synth.conduction import PlateTemperature
from mrgs_synth.shapes import Mesh, box, box_faces, lathe, merge, tube, without
from mrgs_synth.stage import Material, Solid, TemperatureField, constant

AIR_C = 24.0
BOARD_THICKNESS_M = 0.0016
STANDOFF_M = 0.009
TOP_M = STANDOFF_M + BOARD_THICKNESS_M


@dataclass(frozen=True)
class Package:
    """A part with a moulded box for a body.

    Attributes:
        footprint: where it sits.
        top_c: temperature of the hottest point of its upper side, °C.
        coupling: how well it heats the board, see ``Contact``.
        marking: text on it.
        colour: of its body.
        knob: colour of the knob on it; None if it has none.
    """

    footprint: Footprint
    top_c: float
    coupling: float
    marking: tuple[str, ...] = ()
    colour: textures.Colour = (44, 44, 48)
    knob: textures.Colour | None = None


def package(part: Package, board: PlateTemperature, rng: np.random.Generator) -> list[Solid]:
    """A moulded part: its marked top, its sides, its leads, and a knob on those that are turned or
    pressed."""
    footprint, field = part.footprint, _package_c(part, board)
    faces = {
        side: mesh.placed(*footprint.centre_m, TOP_M)
        for side, mesh in box_faces(*footprint.size_m).items()
    }
    size = (round(footprint.size_mm[0] * 16), round(footprint.size_mm[1] * 16))
    top = Material(circuit.marked(part.marking, size, rng, part.colour), "glossy", 0.35)
    plain = Material(textures.plain(part.colour, rng, 64), "glossy", 0.35)
    solids = [
        Solid(f"{footprint.name}_top", faces["top"], top, field),
        Solid(f"{footprint.name}_sides", without(faces, "top"), plain, field),
    ]
    leads = _leads(footprint)
    if leads:
        tin = Material(textures.plain((204, 204, 206), rng, 64), "metal", 0.3)
        solids.append(
            Solid(
                f"{footprint.name}_leads", merge(leads), tin, lambda points: board.at(points) + 1.0
            )
        )
    if part.knob is not None:
        (x, y), height = footprint.centre_m, TOP_M + footprint.size_m[2]
        knob = rod((x, y, height), (x, y, height + 0.0015), 0.0018, 24)
        look = Material(textures.plain(part.knob, rng, 64), "glossy", 0.3)
        solids.append(Solid(f"{footprint.name}_knob", knob, look, field))
    return solids


def _package_c(part: Package, board: PlateTemperature) -> TemperatureField:
    """From the board's temperature at the foot to a top that is hottest over the chip inside."""
    (x, y), (length, width, height) = part.footprint.centre_m, part.footprint.size_m
    sigma = 0.3 * max(length, width)

    def field(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        radius = np.hypot(points[:, 0] - x, points[:, 1] - y)
        top_c = part.top_c - 0.22 * (part.top_c - AIR_C) * (
            1.0 - np.exp(-((radius / sigma) ** 2) / 2.0)
        )
        up = ((points[:, 2] - TOP_M) / height).clip(0.0, 1.0) ** 0.7
        return board.at(points) * (1.0 - up) + top_c * up

    return field


def _leads(part: Footprint) -> list[Mesh]:
    """Pins along two or four sides of a part."""
    (x, y), (length, width, height) = part.centre_m, part.size_m
    steps = np.linspace(-0.43, 0.43, part.count)
    out, low, high = 0.0013, TOP_M, TOP_M + 0.3 * min(height, 0.002)
    half = 0.16 * min(0.0027, 2.0 * length / part.count)
    leads = []
    if part.pads in ("two rows", "four rows"):
        ends = (y - width / 2 - out, y - width / 2), (y + width / 2, y + width / 2 + out)
        leads += [
            beam(a - half, a + half, *end, low, high) for a in x + steps * length for end in ends
        ]
    if part.pads == "four rows":
        ends = (x - length / 2 - out, x - length / 2), (x + length / 2, x + length / 2 + out)
        leads += [
            beam(*end, b - half, b + half, low, high) for b in y + steps * width for end in ends
        ]
    return leads


def regulator(part: Footprint, rng: np.random.Generator) -> list[Solid]:
    """A regulator screwed to an aluminium heat sink with seven fins; the hottest thing on the
    board."""
    (x, y), (length, width, height) = part.centre_m, part.size_m
    front, left, right, top = y - width / 2, x - length / 2, x + length / 2, TOP_M + height
    plate = beam(left, right, front + 0.006, front + 0.009, TOP_M, top)
    fins = [
        beam(a - 0.0006, a + 0.0006, front + 0.009, front + 0.026, TOP_M + 0.002, top)
        for a in np.linspace(left + 0.0006, right - 0.0006, 7)
    ]
    tab = beam(x - 0.005, x + 0.005, front + 0.0047, front + 0.006, TOP_M + 0.004, TOP_M + 0.0205)
    pins = [(x + a, front + 0.0023) for a in (-0.0025, 0.0, 0.0025)]
    legs = [
        beam(a - 0.0005, a + 0.0005, b - 0.0003, b + 0.0003, TOP_M, TOP_M + 0.004) for a, b in pins
    ]
    body, place = box_faces(0.0102, 0.0044, 0.009), (x, front + 0.0025, TOP_M + 0.004)
    marking = Material(circuit.marked(("LM7805", "CT 2431"), (160, 140), rng), "glossy", 0.35)
    black = Material(textures.plain((44, 44, 48), rng), "glossy", 0.35)
    metal = Material(textures.plain((196, 198, 202), rng), "metal", 0.3)

    def sink_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        from_tab = np.hypot(points[:, 0] - x, points[:, 2] - TOP_M - 0.009)
        out = (points[:, 1] - front - 0.009).clip(0.0) / 0.017
        return 64.0 + 14.0 * np.exp(-from_tab / 0.012) - 9.0 * out

    def body_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        return 78.0 + 7.0 * np.exp(
            -((points[:, 0] / 0.004) ** 2) - ((points[:, 2] - 0.0045) / 0.004) ** 2
        )

    return [
        Solid("heat_sink", merge([plate, *fins]), metal, sink_c),
        Solid("regulator_tab", merge([tab, *legs]), metal, constant(79.0)),
        Solid("regulator_front", body["front"], marking, body_c, place),
        Solid("regulator_body", without(body, "front"), black, body_c, place),
    ]


def capacitor(
    part: Footprint, celsius: float, board: PlateTemperature, rng: np.random.Generator
) -> list[Solid]:
    """An electrolytic capacitor: a printed sleeve with a stripe, and a bare aluminium top.

    Args:
        part: where it sits.
        celsius: temperature of its upper half, °C.
        board: the board's temperature, which its foot has.
        rng: of its texture and of how it is turned.
    """
    radius, height = part.size_m[0] / 2, part.size_m[2]
    shoulder, rim, dip = height - 0.0008, 0.8 * radius, height - 0.0003
    sleeve = lathe([(0.0, 0.0), (radius, 0.0)], [(radius, 0.0), (radius, shoulder)], segments=40)
    top = lathe(
        [(radius, shoulder), (0.97 * radius, height), (rim, height), (0.97 * rim, dip)],
        [(0.97 * rim, dip), (0.0, dip)],
        segments=40,
    )
    look = np.array(
        circuit.marked(("470uF", "25V 105C", part.name), (300, 120), rng, (36, 52, 110))
    )
    look[:, 200:240] = (196, 200, 206)
    tin = Material(textures.plain((206, 208, 212), rng, 64), "metal", 0.25)
    foot_c = float(board.at(np.array([[*part.centre_m, 0.0]]))[0])
    place, yaw = (*part.centre_m, TOP_M), float(rng.uniform(0.0, 360.0))

    def field(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        return celsius + (foot_c - celsius) * np.exp(-points[:, 2].clip(0.0) / (0.2 * height))

    return [
        Solid(f"{part.name}_sleeve", sleeve, Material(look, "glossy", 0.2), field, place, yaw),
        Solid(f"{part.name}_top", top, tin, field, place, yaw),
    ]


def toroid(part: Footprint, rng: np.random.Generator) -> Solid:
    """A ring core wound with enamelled wire, hotter within the ring and below, where no air
    moves."""
    radius, wire = 0.36 * part.size_m[0], 0.135 * part.size_m[0]
    angle = np.linspace(0.0, 2.0 * np.pi, 49)
    ring = np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.full(49, wire + 0.0008)], axis=-1
    )
    copper = Material(circuit.winding(1024, 128, 34, rng), "glossy", 0.2)

    def field(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        inside = 1.0 / (1.0 + np.exp((np.hypot(points[:, 0], points[:, 1]) - radius) / 0.0006))
        return 50.0 + 4.0 * inside - 600.0 * (points[:, 2] - wire)

    return Solid(part.name, tube(ring, wire, 20), copper, field, (*part.centre_m, TOP_M))


def connector(part: Footprint, celsius: float, rng: np.random.Generator) -> list[Solid]:
    """A metal shell whose socket opens to the right."""
    faces, place = box_faces(*part.size_m), (*part.centre_m, TOP_M)
    socket = textures.plain((186, 188, 192), rng)
    socket[24:104, 20:108] = (20, 22, 26)
    socket[40:50, 34:94] = (214, 180, 96)
    tin = Material(textures.plain((204, 206, 210), rng), "metal", 0.3)
    return [
        Solid(f"{part.name}_shell", without(faces, "right"), tin, constant(celsius), place),
        Solid(
            f"{part.name}_socket", faces["right"], Material(socket), constant(celsius - 0.5), place
        ),
    ]


def header(part: Footprint, rng: np.random.Generator) -> list[Solid]:
    """Two rows of gilded pins in a black strip."""
    (x, y), (length, width, height) = part.centre_m, part.size_m
    half = 0.00032
    places = [
        (a, b)
        for a in x + np.linspace(-0.475, 0.475, part.count) * length
        for b in (y - 0.00127, y + 0.00127)
    ]
    pins = [beam(a - half, a + half, b - half, b + half, TOP_M, TOP_M + height) for a, b in places]
    gold = Material(textures.plain((226, 186, 96), rng, 64), "metal", 0.25)
    black = Material(textures.plain((36, 36, 38), rng, 64), "glossy", 0.3)
    return [
        Solid(f"{part.name}_pins", merge(pins), gold, constant(28.5)),
        Solid(
            f"{part.name}_strip",
            box(length, width, 0.0025).placed(x, y, TOP_M),
            black,
            constant(28.5),
        ),
    ]
