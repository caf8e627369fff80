"""A pane of the viewer, and what it may be painted from."""

from __future__ import annotations

import numpy as np

from mrgs.scene import RGB, THERMAL, Camera, TemperatureRange
from mrgs.viewer.panes import Pane, PaneImages

SIZE = (160, 120)
RANGE = TemperatureRange(0.0, 50.0)


def heat(depth: float = 3.0) -> PaneImages:
    """A ramp from 10 to 30 °C, all at one depth, over grey."""
    values = np.tile(np.linspace(10, 30, 160, dtype=np.float32), (120, 1))
    return PaneImages(
        {RGB: np.full((120, 160, 3), 100, np.uint8), THERMAL: values},
        np.full((120, 160), depth, np.float32),
        np.ones((120, 160), bool),
    )


def thermal_pane(camera: Camera, kind: str = "image") -> Pane:
    return Pane(kind, (THERMAL,), camera)
