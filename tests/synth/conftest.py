from __future__ import annotations

import numpy as np
import pytest

from mrgs_synth.cameras import CameraArc
from mrgs_synth.electronics import electronics
from mrgs_synth.facade import facade
from mrgs_synth.shapes import box
from mrgs_synth.stage import Lamp, Material, Solid, Stage, constant
from mrgs_synth.tabletop import tabletop


@pytest.fixture(scope="session")
def table() -> Stage:
    return tabletop(0)


@pytest.fixture(scope="session")
def house() -> Stage:
    return facade(0)


@pytest.fixture(scope="session")
def circuit_board() -> Stage:
    return electronics(0)


@pytest.fixture
def two_boxes() -> Stage:
    """A red box at 50 °C on a large grey slab at 20 °C whose top is z = 0."""
    grey = Material(np.full((4, 4, 3), 128, dtype=np.uint8))
    red = Material(np.full((4, 4, 3), (220, 20, 20), dtype=np.uint8))
    return Stage(
        solids=(
            Solid(
                "slab",
                box(40.0, 40.0, 0.1),
                grey,
                lambda p: np.full(len(p), 20.0),
                (0.0, 0.0, -0.1),
            ),
            Solid(
                "box",
                box(0.3, 0.2, 0.2),
                red,
                lambda p: 50.0 + 10.0 * p[:, 2],
                (0.1, 0.0, 0.0),
                30.0,
            ),
        ),
        lamps=(Lamp((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), (2.0, 2.0), (4.0, 4.0, 4.0)),),
        sky=(0.5, 0.5, 0.5),
        exposure=1.0,
        cameras=CameraArc((0.0, 0.0, 0.1), (-90.0, 90.0), ((35.0, 1.2), (60.0, 1.2))),
        beyond_c=constant(-5.0),
    )
