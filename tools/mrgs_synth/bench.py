"""What lies around the board of the scene ``electronics``: bench, mat, cables, a multimeter and
tools."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mrgs_synth import circuit, textures
from mrgs_synth.building import rod
from mrgs_synth.circuit import Footprint
from mrgs_synth.conduction import Contact, Plate, PlateTemperature, solve
from mrgs_synth.shapes import box, box_faces, lathe, merge, tube, without
from mrgs_synth.stage import Material, Solid, TemperatureField, constant

AIR_C = 24.0
MAT = Plate(length_m=0.46, width_m=0.32, spread_m=0.012, ambient_c=AIR_C, cell_m=0.002)
MAT_M = 0.002
CABLES = (  # name, offset along the terminal in metres, colour, temperature in °C
    ("red", -0.008, (190, 36, 34), 28.0),
    ("black", 0.0, (36, 36, 38), 46.0),
    ("yellow", 0.008, (226, 190, 50), 27.0),
)
BEFORE = (-0.09, 0.105)  # where the board lay before


def bench(terminal: Footprint, board_m: float, rng: np.random.Generator) -> list[Solid]:
    """Everything but the board.

    Args:
        terminal: the screw terminal that the cables come from.
        board_m: height of the board's upper side above the mat.
        rng: of the textures.
    """
    return [*_mat(rng), *_terminal(terminal, board_m, rng), *_tools(rng)]


def _mat(rng: np.random.Generator) -> list[Solid]:
    """The mat, warm below the board and a little where the board lay before, on a wooden bench."""
    x, y = MAT.cell_centres()
    below = (np.abs(x) < 0.08) & (np.abs(y) < 0.05)
    hot = np.hypot(x + 0.05, y - 0.01) < 0.035
    before = (np.abs(x - BEFORE[0]) < 0.08) & (np.abs(y - BEFORE[1]) < 0.05)
    warmth = [Contact(below, 34.0, 0.8), Contact(hot, 50.0, 0.5), Contact(before, 28.5, 0.6)]
    mat: PlateTemperature = solve(MAT, warmth)
    faces = box_faces(MAT.length_m, MAT.width_m, MAT_M)
    look = Material(circuit.cutting_mat((460.0, 320.0), rng))
    place = (0.0, 0.0, -MAT_M)
    wood = Material(
        textures.wood(900, 1200, 9, rng, (120, 84, 52), (206, 164, 112)), "glossy", 0.35
    )
    return [
        Solid("mat", faces["top"], look, mat.at, place),
        Solid(
            "mat_sides",
            without(faces, "top"),
            Material(textures.plain((40, 70, 106), rng)),
            mat.at,
            place,
        ),
        Solid("bench", box(2.6, 2.2, 0.04), wood, constant(23.6), (0.0, 0.0, -MAT_M - 0.04)),
    ]


def _terminal(terminal: Footprint, board_m: float, rng: np.random.Generator) -> list[Solid]:
    """A screw terminal and the cables that feed the board; the middle one carries most and is
    warm."""
    (x, y), (length, _, height) = terminal.centre_m, terminal.size_m
    top = board_m + height
    screws = [
        rod((x, y + dy, top), (x, y + dy, top + 0.0004), 0.0022, 20) for dy in (-0.008, 0.0, 0.008)
    ]
    green = Material(textures.plain((46, 140, 84), rng), "glossy", 0.3)
    steel = Material(textures.plain((190, 190, 194), rng), "metal", 0.3)

    def body_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        return 33.0 + 5.0 * np.exp(-(((points[:, 1] - y) / 0.006) ** 2))

    cables = []
    for name, dy, colour, warm_c in CABLES:
        insulation = Material(textures.plain(colour, rng), "glossy", 0.25)
        path = _cable((x - length / 2, y + dy, board_m + 0.003), dy)
        cables.append(
            Solid(f"cable_{name}", tube(path, 0.0016, 12), insulation, _cable_c(x, warm_c))
        )
    return [
        Solid("terminal", terminal.body(board_m), green, body_c),
        Solid("terminal_screws", merge(screws), steel, constant(36.0)),
        *cables,
    ]


def _cable(start: tuple[float, float, float], dy: float) -> Float[np.ndarray, "40 3"]:
    """A Bézier curve from the terminal down to the mat and away to the front."""
    x, y, z = start
    points = np.array(
        [
            start,
            (x - 0.035, y, z + 0.016),
            (x - 0.06, y + 3.0 * dy - 0.05, z - 0.012),
            (x - 0.125, y + 5.0 * dy - 0.16, 0.0),
        ]
    )
    t = np.linspace(0.0, 1.0, 40)[:, None]
    weights = np.concatenate([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3], axis=1)
    path = np.einsum("nk,kc->nc", weights, points)
    path[:, 2] = np.maximum(path[:, 2], 0.0018)
    return path


def _cable_c(x: float, warm_c: float) -> TemperatureField:
    """Warmest at the terminal, and then as warm as its current makes it, cooler where it lies on
    the mat."""

    def field(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        away = np.maximum(x - points[:, 0], 0.0)
        return (
            AIR_C
            + (warm_c - AIR_C) * (0.7 + 0.3 * np.exp(-away / 0.02))
            + 6.0 * np.exp(-away / 0.008)
        )

    return field


def _tools(rng: np.random.Generator) -> list[Solid]:
    """A multimeter that is on, a screwdriver and a reel of solder."""
    faces = box_faces(0.085, 0.17, 0.035)
    front = Material(circuit.display(680, 340, "12.04", rng), "glossy", 0.2)
    yellow = Material(textures.plain((236, 190, 40), rng), "glossy", 0.3)
    place, yaw = (0.045, 0.15, 0.0), 98.0
    tip, ferrule, end = (-0.09, -0.088, 0.004), (0.01, -0.118, 0.0095), (0.105, -0.1465, 0.0095)
    handle = rod(ferrule, end, 0.0095, 6)
    red, black = (206, 60, 44), (30, 30, 32)
    grip = textures.bands(256, 128, [(0.15, black), (0.8, red), (0.9, black), (1.0, red)], rng)
    reel = lathe(
        [(0.006, 0.0), (0.03, 0.0)],
        [(0.03, 0.0), (0.03, 0.003), (0.024, 0.004)],
        [(0.024, 0.004), (0.024, 0.026)],
        [(0.024, 0.026), (0.03, 0.027), (0.03, 0.03)],
        [(0.03, 0.03), (0.006, 0.03)],
        [(0.006, 0.03), (0.006, 0.0)],
    )
    turns = np.sin(np.linspace(0.0, 300.0, 512))[:, None] * np.ones((1, 64))
    solder = textures.blend((120, 122, 126), (216, 218, 220), 0.5 + 0.5 * turns)
    blade = rod(tip, ferrule, 0.003, 16)
    steel = Material(textures.plain((180, 182, 188), rng), "metal", 0.25)
    return [
        Solid("meter_front", faces["top"], front, _meter_c, place, yaw),
        Solid("meter_case", without(faces, "top"), yellow, _meter_c, place, yaw),
        Solid("reel", reel, Material(solder, "glossy", 0.3), constant(24.4), (0.17, 0.075, 0.0)),
        Solid("screwdriver", handle, Material(grip, "glossy", 0.2), _hand_warm_c),
        Solid("rod", blade, steel, constant(24.2)),
    ]


def _meter_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Slightly warm over its battery and behind its display."""
    battery = np.exp(-(((points[:, 0]) / 0.025) ** 2) - ((points[:, 1] + 0.045) / 0.03) ** 2)
    return 25.2 + 1.8 * battery + 0.9 * (points[:, 1] > 0.03)


def _hand_warm_c(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """The handle, laid down a minute ago."""
    return 25.0 + 4.0 * np.exp(-(((points[:, 0] - 0.06) / 0.03) ** 2))
