"""``rgb.ply``, ``thermal.ply`` ...: splats as PLY files in the layout of the 3DGS family."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from mrgs.data.ply import write_ply
from mrgs.export.job import ExportJob, comment_lines, described
from mrgs.export.splats import SplatArrays, base_values, value_names
from mrgs.pictures.files import to_array
from mrgs.runs.baked import BakedModel
from mrgs.scene import RGB

SMALLEST_SCALE = 1e-12
"""Scales are floored here, so that their logarithm is finite."""

OPACITY_MARGIN = 1e-7
"""Opacities are kept this far from 0 and 1, so that their logit is finite."""


def export(job: ExportJob) -> list[Path]:
    """Write each modality's file, and unless RGB is all ``rgb_thermal.ply``, with sidecars."""
    paths = []
    for modality, splats, facts in job.splats():
        path = job.folder / f"{modality}.ply"
        paths += described(write_splat_ply(path, splats, comment_lines(facts)), facts)
    if job.modalities == (RGB,):
        return paths
    _, shown, facts = next(job.splats())
    path = job.folder / "rgb_thermal.ply"
    combined = write_combined_ply(path, shown, job.splat_model, comment_lines(facts))
    return [*paths, *described(combined, facts)]


def write_splat_ply(path: Path, splats: SplatArrays, comments: Sequence[str] = ()) -> Path:
    """Write the layout of 3DGS: scales as logarithms, the opacity as a logit, rotations wxyz.
    RunError if the file cannot be written."""
    return write_ply(path, {"vertex": splat_columns(splats)}, comments)


def write_combined_ply(
    path: Path, shown: SplatArrays, baked: BakedModel, comments: Sequence[str] = ()
) -> Path:
    """Write the layout of 3DGS for viewers that do not know more, and behind it of each modality
    but RGB ``opacity_NAME`` (a logit) and its values, see ``value_names``: temperatures are
    ``temperature_c``, or ``temperature_normalised`` where the scene has no °C."""
    columns = splat_columns(shown)
    for modality in baked.modalities:
        if modality != RGB:
            columns[f"opacity_{modality}"] = logit(to_array(baked.opacities[modality]))
            values = base_values(baked, modality)
            columns |= dict(zip(value_names(baked, modality), values.T, strict=True))
    return write_ply(path, {"vertex": columns}, comments)


def splat_columns(splats: SplatArrays) -> dict[str, np.ndarray]:
    """3DGS's properties in its order; normals are zero, higher coefficients channel by channel."""
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
    """Logit of opacities in [0, 1], [N]; kept finite by ``OPACITY_MARGIN``."""
    inside = opacities.astype(np.float64).clip(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    return (np.log(inside) - np.log1p(-inside)).astype(np.float32)


def log_of(scales: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
    """Natural logarithm of standard deviations [N, 3], floored at ``SMALLEST_SCALE``."""
    return np.log(scales.clip(SMALLEST_SCALE))
