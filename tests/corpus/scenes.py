"""Scene folders as other programs lay them out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tests.helpers.layouts import HEIGHT, WIDTH, SceneWriter

LENS = {"fl_x": 20.0, "fl_y": 22.0, "cx": 12.5, "cy": 7.5, "w": WIDTH, "h": HEIGHT}


def write_pairs(writer: SceneWriter, rgb: str, thermal: str, names: Sequence[str]) -> None:
    """Images of both cameras in these folders."""
    for index, name in enumerate(names):
        writer.image(f"{rgb}/{name}.png", seed=index)
        writer.image(f"{thermal}/{name}.png", "L", seed=100 + index)


def write_colours(path: Path, colours: np.ndarray, kind: str) -> Path:
    """A point cloud in text with colours of a type of PLY."""
    header = ["ply", "format ascii 1.0", f"element vertex {len(colours)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"property {kind} {name}" for name in ("red", "green", "blue")]
    form = "d" if kind == "uchar" else ".4f"
    rows = [
        " ".join(
            ["0", "0", str(index), *(format(round(x) if form == "d" else x, form) for x in row)]
        )
        for index, row in enumerate(colours)
    ]
    path.write_text("\n".join([*header, "end_header", *rows]) + "\n")
    return path
