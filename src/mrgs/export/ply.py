"""PLY files: the splats as the 3DGS family stores them, and rows of any other kind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from mrgs.export.splats import Splats, rgb_splats, shown_temperatures, temperature_name, to_float32
from mrgs.runs.baked import BakedModel
from mrgs.system.atomic import replacing

SMALLEST_SCALE = 1e-12
"""Scales are floored here, so that their logarithm is finite."""

OPACITY_MARGIN = 1e-7
"""Opacities are kept this far from 0 and 1, so that their logit is finite."""

_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}


def write_ply(path: Path, elements: Mapping[str, np.ndarray], comments: Sequence[str] = ()) -> Path:
    """Write a binary PLY file; returns the path.

    Args:
        path: of the file.
        elements: rows by the element's name. A structured array gives scalar properties; a plain
            [N, K] array of int32 is written as lists of K ``vertex_indices``.
        comments: lines for the header; what is not ASCII is written as degrees Celsius or ?.

    Raises:
        RunError: the file cannot be written.
    """
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {_ascii(line)}" for line in comments),
    ]
    for name, rows in elements.items():
        header += [f"element {name} {len(rows)}", *_properties(rows)]
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        for rows in elements.values():
            file.write(
                np.ascontiguousarray(rows if rows.dtype.names else _lists(rows)).view(np.uint8).data
            )
    return path


def table(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Columns of equal length as one structured array, little-endian."""
    kinds = [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()]
    rows = np.empty(len(next(iter(columns.values()))), dtype=kinds)
    for name, column in columns.items():
        rows[name] = column
    return rows


def write_splat_ply(path: Path, splats: Splats, comments: Sequence[str] = ()) -> Path:
    """Write the layout of 3DGS: scales as logarithms, the opacity as a logit, rotations wxyz.

    Raises:
        RunError: the file cannot be written.
    """
    return write_ply(path, {"vertex": table(splat_columns(splats))}, comments)


def write_rgb_thermal_ply(path: Path, baked: BakedModel, comments: Sequence[str] = ()) -> Path:
    """Write the layout of 3DGS for RGB with ``opacity_thermal`` (a logit) and the temperature
    behind it.

    The temperature is ``temperature_c``, or ``temperature_normalised`` where the scene has no °C.
    Viewers that do not know the two show the colours.

    Raises:
        RunError: the file cannot be written.
    """
    columns = splat_columns(rgb_splats(baked))
    columns["opacity_thermal"] = logit(to_float32(baked.opacity_thermal))
    columns[temperature_name(baked)] = shown_temperatures(baked)
    return write_ply(path, {"vertex": table(columns)}, comments)


def splat_columns(splats: Splats) -> dict[str, np.ndarray]:
    """The properties of 3DGS in its order; the normals are zero, the higher coefficients channel by
    channel."""
    columns: dict[str, np.ndarray] = {axis: splats.means[:, i] for i, axis in enumerate("xyz")}
    columns |= dict.fromkeys(("nx", "ny", "nz"), np.zeros(len(splats), np.float32))
    columns |= {f"f_dc_{channel}": splats.sh[:, 0, channel] for channel in range(3)}
    bands = splats.sh.shape[1] - 1
    for channel in range(3):
        columns |= {
            f"f_rest_{channel * bands + band}": splats.sh[:, 1 + band, channel]
            for band in range(bands)
        }
    columns["opacity"] = logit(splats.opacities)
    log_scales = log_of(splats.scales)
    columns |= {f"scale_{i}": log_scales[:, i] for i in range(3)}
    columns |= {f"rot_{i}": splats.quats[:, i] for i in range(4)}
    return columns


def logit(opacities: Float[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
    """The inverse of the sigmoid, finite."""
    inside = opacities.astype(np.float64).clip(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    return (np.log(inside) - np.log1p(-inside)).astype(np.float32)


def log_of(scales: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
    """Natural logarithm of the standard deviations, finite."""
    return np.log(scales.clip(SMALLEST_SCALE))


def _properties(rows: np.ndarray) -> list[str]:
    if rows.dtype.names is None:
        return ["property list uchar int vertex_indices"]
    return [f"property {_TYPES[rows.dtype[name].str[1:]]} {name}" for name in rows.dtype.names]


def _lists(rows: np.ndarray) -> np.ndarray:
    lists = np.empty(len(rows), dtype=[("count", "u1"), ("indices", "<i4", rows.shape[1:])])
    lists["count"] = rows.shape[1]
    lists["indices"] = rows
    return lists


def _ascii(line: str) -> str:
    text = " ".join(line.split()).replace("°C", "degrees Celsius")
    return text.encode("ascii", "replace").decode("ascii")
