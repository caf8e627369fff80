"""``.splat`` files: 32 bytes per splat, no view dependence, no header."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mrgs.export.splats import Splats, to_bytes
from mrgs.system.atomic import replacing

_LAYOUT = [("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)]


def write_splat(path: Path, splats: Splats) -> Path:
    """Write the layout that antimatter15's viewer made common; returns the path.

    Centre and standard deviations as float32, RGB of degree 0 and opacity as bytes, the quaternion
    wxyz as bytes about 128. The largest and most opaque splats come first, so that a file shows
    something while it loads.

    Raises:
        RunError: the file cannot be written.
    """
    order = np.argsort(-splats.scales.prod(axis=1) * splats.opacities, kind="stable")
    rows = np.empty(len(splats), dtype=_LAYOUT)
    rows["mean"] = splats.means[order]
    rows["scale"] = splats.scales[order]
    rows["color"][:, :3] = splats.base_colors[order]
    rows["color"][:, 3] = to_bytes(splats.opacities[order])
    rows["quat"] = np.rint(splats.quats[order] * 128 + 128).clip(0, 255)
    with replacing(path) as temporary:
        rows.tofile(temporary)
    return path
