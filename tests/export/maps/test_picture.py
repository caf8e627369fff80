from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from mrgs.export.maps.picture import MARGIN, frame_map
from mrgs.pictures.drawing import PAPER, Scale

SIZE = 600


@pytest.mark.parametrize("angle", [0.0, 180.0, -65.0])
def test_the_n_of_the_arrow_lies_towards_north(angle):
    body, scale = Image.new("RGB", (SIZE, SIZE), PAPER), Scale("grey", 0.0, 1.0, "°C")
    without, framed = (
        np.asarray(frame_map(body, 0.01, scale, north_deg).convert("L"), float)
        for north_deg in (None, angle)
    )
    y, x = np.nonzero(np.abs(framed - without) > 60)
    x, y = x - (MARGIN + SIZE - 24), y - (SIZE + 2 * MARGIN + 10)
    tip = np.hypot(x, y) > 25
    assert tip.sum() > 20
    found = np.degrees(np.arctan2(x[tip].mean(), -y[tip].mean()))
    assert abs((found - angle + 180) % 360 - 180) < 4
