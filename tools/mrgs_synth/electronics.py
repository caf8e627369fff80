"""The scene ``electronics``: a powered circuit board on a bench, 160 × 100 mm, with parts from 24
to 85 °C.

The origin is the bench mat below the board's centre, z up, metres. The board's temperatures follow
from steady heat conduction along it (see ``conduction``) from the parts that heat it; so do the
mat's below the board. Four things show in thermal images alone: a capacitor that fails, a short
circuit under the solder mask, which of two equal transistors does the work, and the place on the
mat where the board lay before.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from mrgs_synth import circuit, textures
from mrgs_synth.bench import bench
from mrgs_synth.building import rod
from mrgs_synth.cameras import CameraArc
from mrgs_synth.circuit import Footprint
from mrgs_synth.components import (
    AIR_C,
    BOARD_THICKNESS_M,
    STANDOFF_M,
    TOP_M,
    Package,
    capacitor,
    connector,
    header,
    package,
    regulator,
    toroid,
)
from mrgs_synth.conduction import Contact, Plate, PlateTemperature, solve
from mrgs_synth.shapes import box_faces, merge, without
from mrgs_synth.stage import Lamp, Material, Solid, Stage, TemperatureField, constant

BOARD = Plate(length_m=0.16, width_m=0.1, spread_m=0.014, ambient_c=30.0, cell_m=0.001)

PACKAGES = (
    Package(
        Footprint("U1", 12, 6, (14, 14, 1.6), "four rows", 16),
        53.0,
        2.0,
        ("MR-4210", "ARM 168M", "2447 B1"),
    ),
    Package(
        Footprint("U2", -16, 14, (17, 17, 2.4), "none"),
        64.0,
        3.0,
        ("GRAPHIT", "FPGA-85K", "C8  TWN", "24-31"),
    ),
    Package(Footprint("U3", 34, -18, (6, 5, 1.6), "two rows", 4), 39.0, 1.0, ("LM358", "A24")),
    Package(Footprint("U4", 36, 10, (10, 6, 1.6), "two rows", 7), 42.0, 1.0, ("MAX232", "EKA 5")),
    Package(Footprint("U5", 14, -14, (12, 8, 1.2), "two rows", 10), 36.0, 0.8, ("FLASH", "128M-7")),
    Package(Footprint("Q1", -50, -10, (6.6, 7, 2.3), "ends"), 76.0, 5.0, ("IRF", "7413")),
    Package(Footprint("Q2", -50, -22, (6.6, 7, 2.3), "ends"), 44.0, 2.0, ("IRF", "7413")),
    Package(Footprint("D1", -41, -6, (5, 3.6, 2.2), "ends"), 66.0, 3.0, ("SS34",)),
    Package(Footprint("L1", -33, -23, (12, 12, 7), "ends"), 58.0, 2.0, ("470",), (70, 70, 74)),
    Package(Footprint("L2", -17, -25, (10, 10, 5), "ends"), 47.0, 2.0, ("220",), (70, 70, 74)),
    Package(
        Footprint("K1", 54, -33, (19, 15, 15), "two rows", 4),
        46.0,
        1.0,
        ("RELAY 12V", "10A 250VAC"),
        (30, 64, 128),
    ),
    Package(
        Footprint("RV1", 48, 34, (9.5, 9.5, 6), "none"),
        29.0,
        0.3,
        ("10K",),
        (40, 96, 190),
        (226, 214, 190),
    ),
    Package(Footprint("R1", -41, -15, (6.4, 3.2, 0.9), "ends"), 71.0, 4.0, ("R010",)),
    Package(
        Footprint("SW1", 28, 38, (6, 6, 4), "two rows", 2),
        28.0,
        0.2,
        (),
        (60, 60, 62),
        (196, 52, 44),
    ),
    Package(
        Footprint("SW2", 16, 38, (6, 6, 4), "two rows", 2),
        28.0,
        0.2,
        (),
        (60, 60, 62),
        (226, 214, 190),
    ),
)
REGULATOR = Footprint("VR1", -56, 27, (24, 26, 28))
CAPACITORS = {  # and the temperature in °C
    Footprint("C1", -70, -36, (10, 10, 14)): 34.0,
    Footprint("C2", -57, -37, (10, 10, 14)): 36.0,
    Footprint("C3", -44, -38, (10, 10, 12)): 52.0,
    Footprint("C4", -33, 36, (8, 8, 11)): 41.0,
    Footprint("C5", -22, 37, (8, 8, 11)): 37.0,
    Footprint("C6", -2, -10, (6.3, 6.3, 7)): 38.0,
}
TOROID = Footprint("L3", -35, 5.5, (18, 18, 7))
CRYSTAL = Footprint("Y1", 27, 22, (11, 4.6, 3.6))
CONNECTORS = {  # metal shells, and their temperature in °C
    Footprint("J1", 72, 28, (16, 12, 11)): 30.0,
    Footprint("J2", 69, 4, (21, 16, 13.5)): 33.0,
}
HEADER = Footprint("J3", 8, -39, (51, 5, 8.5), "grid", 20)
TERMINAL = Footprint("J4", -74, -12, (10, 26, 11))
LARGE_PARTS = (
    *(p.footprint for p in PACKAGES),
    *CAPACITORS,
    *CONNECTORS,
    REGULATOR,
    TOROID,
    CRYSTAL,
    HEADER,
    TERMINAL,
)
CHIP_SIZES_MM = ((3.2, 1.6, 0.8), (2.0, 1.25, 0.9), (3.2, 1.6, 1.3))
SHORT_MM = (30.0, 52.0, -4.0)  # a trace from x to x at y


def electronics(seed: int) -> Stage:
    """Build the scene; the seed chooses the textures and the small parts."""
    rng = np.random.default_rng([seed, 0])
    chips = _chips(rng)
    board = solve(BOARD, _contacts(BOARD, chips))
    solids = [*_board(board, chips, rng), *bench(TERMINAL, TOP_M, rng)]
    for part in PACKAGES:
        solids += package(part, board, rng)
    for place, celsius in CAPACITORS.items():
        solids += capacitor(place, celsius, board, rng)
    for place, celsius in CONNECTORS.items():
        solids += connector(place, celsius, rng)
    solids += [*regulator(REGULATOR, rng), toroid(TOROID, rng), *header(HEADER, rng)]
    return Stage(
        solids=tuple(solids),
        lamps=(
            Lamp((0.35, 0.3, 0.95), (0.0, 0.0, 0.0), (0.35, 0.35), (15.0, 14.6, 13.8)),
            Lamp((-0.75, -0.6, 0.9), (0.0, 0.0, 0.0), (0.5, 0.3), (6.0, 5.4, 4.6)),
        ),
        sky=(0.42, 0.44, 0.48),
        exposure=1.15,
        cameras=CameraArc(
            target=(0.0, 0.0, 0.012),
            azimuth_deg=(-165.0, 50.0),
            rings=((32.0, 0.35), (50.0, 0.29), (68.0, 0.26), (42.0, 0.23)),
            fov_deg=42.0,
            jitter_m=0.004,
        ),
        beyond_c=constant(AIR_C),
        point_noise_m=0.0004,
    )


def _under(plate: Plate, part: Footprint) -> Bool[np.ndarray, "rows columns"]:
    """The cells of the board that a part covers."""
    x, y = plate.cell_centres()
    centre, (length, width, _) = part.centre_m, part.size_m
    return (np.abs(x - centre[0]) < length / 2) & (np.abs(y - centre[1]) < width / 2)


def _contacts(plate: Plate, chips: dict[Footprint, float]) -> list[Contact]:
    """What heats the board, and the connectors, through which it loses heat."""
    x, y = plate.cell_centres()
    contacts = [Contact(_under(plate, p.footprint), p.top_c - 2.0, p.coupling) for p in PACKAGES]
    contacts += [Contact(_under(plate, part), celsius, 0.5) for part, celsius in CAPACITORS.items()]
    contacts += [
        Contact(_under(plate, REGULATOR), 74.0, 0.8),
        Contact(_under(plate, TOROID), 50.0, 0.8),
    ]
    contacts += [
        Contact(_under(plate, part), 32.0 + rise_c, 1.0)
        for part, rise_c in chips.items()
        if rise_c > 0.0
    ]
    left, right, height = (value / 1000.0 for value in SHORT_MM)
    short = (
        (x > left) & (x < right) & (np.abs(y - height - 0.3 * np.maximum(x - 0.042, 0.0)) < 0.0011)
    )
    cool = [
        Contact(_under(plate, part), AIR_C + 4.0, 2.0) for part in (*CONNECTORS, HEADER, TERMINAL)
    ]
    return [*contacts, Contact(short, 68.0, 9.0), *cool]


def _chips(rng: np.random.Generator) -> dict[Footprint, float]:
    """Small resistors and capacitors where nothing else sits, and how much hotter than the board
    they are, °C."""
    chips: dict[Footprint, float] = {}
    while len(chips) < 90:
        x, y = (round(float(value), 1) for value in rng.uniform((-74.0, -45.0), (74.0, 45.0)))
        length, width, height = CHIP_SIZES_MM[rng.integers(len(CHIP_SIZES_MM))]
        if rng.uniform() < 0.4:
            length, width = width, length
        chip = Footprint(
            f"{'CR'[int(height < 0.85)]}{10 + len(chips)}", x, y, (length, width, height), "ends"
        )
        if not any(_too_near(chip, other) for other in (*LARGE_PARTS, *chips)):
            chips[chip] = float(rng.choice([0.0, 2.0, 9.0, 20.0], p=[0.5, 0.3, 0.14, 0.06]))
    return chips


def _too_near(part: Footprint, other: Footprint) -> bool:
    """Whether less than 2 mm of free board is between two parts."""
    reach_x = (part.size_mm[0] + other.size_mm[0]) / 2 + 2.0
    reach_y = (part.size_mm[1] + other.size_mm[1]) / 2 + 2.0
    return abs(part.x_mm - other.x_mm) < reach_x and abs(part.y_mm - other.y_mm) < reach_y


def _board(
    board: PlateTemperature, chips: dict[Footprint, float], rng: np.random.Generator
) -> list[Solid]:
    """The board, the pillars that it stands on, its quartz crystal, and its small parts."""
    look = circuit.board((160.0, 100.0), [*LARGE_PARTS, *chips], "MRGS POWER DEMO  REV C", rng)
    faces = box_faces(BOARD.length_m, BOARD.width_m, BOARD_THICKNESS_M)
    place = (0.0, 0.0, STANDOFF_M)
    corners = [(x, y) for x in (-0.076, 0.076) for y in (-0.046, 0.046)]
    pillars = [rod((x, y, 0.0), (x, y, STANDOFF_M), 0.003, 6) for x, y in corners]
    screws = [rod((x, y, TOP_M), (x, y, TOP_M + 0.002), 0.0028, 20) for x, y in corners]
    brass = Material(textures.plain((214, 176, 96), rng), "metal", 0.25)
    fr4 = Material(
        textures.bands(
            32, 64, [(0.2, (20, 84, 54)), (0.8, (190, 178, 120)), (1.0, (20, 84, 54))], rng
        )
    )
    can = Material(textures.plain((206, 208, 212), rng, 64), "metal", 0.22)
    return [
        Solid("board", faces["top"], Material(look, "glossy", 0.25), board.at, place),
        Solid("board_sides", without(faces, "top"), fr4, board.at, place),
        Solid("pillars", merge([*pillars, *screws]), brass, lambda points: board.at(points) - 1.0),
        Solid("crystal", CRYSTAL.body(TOP_M), can, lambda points: board.at(points) + 0.5),
        *_chip_solids(board, chips, rng),
    ]


def _chip_solids(
    board: PlateTemperature, chips: dict[Footprint, float], rng: np.random.Generator
) -> list[Solid]:
    """One solid for all small parts of one kind and one excess over the board's temperature."""
    solids = []
    for letter, colour in (("R", (40, 40, 42)), ("C", (176, 138, 100))):
        texture = textures.plain(colour, rng, 64)
        texture[:, :14] = texture[:, -14:] = (208, 204, 196)
        for rise_c in sorted(set(chips.values())):
            bodies = [
                part.body(TOP_M)
                for part, rise in chips.items()
                if part.name[0] == letter and rise == rise_c
            ]
            if bodies:
                name = f"chips_{letter}_{rise_c:.0f}"
                solids.append(Solid(name, merge(bodies), Material(texture), _warmer(board, rise_c)))
    return solids


def _warmer(board: PlateTemperature, rise_c: float) -> TemperatureField:
    return lambda points: board.at(points) + rise_c
