"""The splats of one modality as plain arrays, as every splat format stores them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from mrgs.errors import ConfigError, RunError
from mrgs.field.spherical_harmonics import C0
from mrgs.pictures.drawing import Scale
from mrgs.pictures.files import to_array
from mrgs.pictures.palette import PaletteName, palette_table
from mrgs.pictures.values import full_scale, in_unit
from mrgs.runs.baked import BakedModel
from mrgs.scene import THERMAL, Modality
from mrgs.system.memory import row_chunks


@dataclass(frozen=True, eq=False)
class SplatArrays:
    """N coloured splats: centres in the world (scene units), rotations wxyz of unit length,
    standard deviations along the rotated axes, opacities in (0, 1), and colour coefficients as 3DGS
    has them (colour = max(0, 0.5 + Σ)), B of them 1, 4, 9 or 16."""

    means: Float32[np.ndarray, "n 3"]
    quats: Float32[np.ndarray, "n 4"]
    scales: Float32[np.ndarray, "n 3"]
    opacities: Float32[np.ndarray, " n"]
    sh: Float32[np.ndarray, "n b 3"]

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Highest degree of the colour coefficients, 0 to 3."""
        return round(self.sh.shape[1] ** 0.5) - 1

    @property
    def base_colors(self) -> UInt8[np.ndarray, "n 3"]:
        """The colours of degree 0 as bytes, for formats that do not know directions."""
        return to_bytes(0.5 + C0 * self.sh[:, 0])


def thermal_scale(
    baked: BakedModel, palette: PaletteName = "inferno", limits: tuple[float, float] | None = None
) -> Scale:
    """The palette over the given temperatures, °C; over the scene's whole range where none are
    given. ConfigError for limits in °C of a model without °C, or limits that are not ascending."""
    whole = full_scale(THERMAL, baked.temperature, palette)
    if limits is None:
        return whole
    if baked.temperature is None:
        raise ConfigError(
            "a range in °C was given, but the scene has no temperature range: leave the range out"
        )
    require_ascending(*limits)
    return whole._replace(low=float(limits[0]), high=float(limits[1]))


def require_ascending(low: float, high: float) -> None:
    """ConfigError unless these are the ends of a range of temperatures."""
    if not -np.inf < low < high < np.inf:
        raise ConfigError(
            f"the temperature range {low:g} to {high:g} °C is not ascending: swap its ends"
        )


def require_exportable(baked: BakedModel) -> None:
    """Check that there is something to write, and that all of it is finite. RunError if the model
    has no splats, or some have NaN or infinity."""
    if len(baked) == 0:
        raise RunError("the model has no splats, so there is nothing to export: retrain it")
    broken = 0
    for rows in row_chunks(len(baked)):
        parts = [
            tensor[rows].reshape(rows.stop - rows.start, -1) for tensor in baked.tensors().values()
        ]
        finite = torch.stack([part.isfinite().all(dim=1) for part in parts]).all(dim=0)
        broken += int((~finite).sum())
    if broken:
        raise RunError(
            f"{broken} of {len(baked)} splats hold NaN or infinity, so the model cannot be "
            f"exported: retrain it, or go on from an older checkpoint"
        )


def shaded_splats(baked: BakedModel, modality: Modality) -> SplatArrays:
    """Spherical harmonics of a modality other than thermal with its opacity; the mean of the
    channels as grey if they are not three."""
    sh = baked.sh(modality)
    if modality.channels != 3:
        sh = sh.mean(dim=2, keepdim=True).expand(-1, -1, 3)
    return _splats(baked, baked.opacities[modality], to_array(sh))


def thermal_splats(baked: BakedModel, scale: Scale) -> SplatArrays:
    """The temperatures in the colours of a palette, with the thermal opacity; of degree 0. A viewer
    blends these colours, not the temperatures: at an edge they may not be on the palette."""
    position = (shown_temperatures(baked) - scale.low) / (scale.high - scale.low)
    colors = palette_table(scale.palette)[np.rint(position.clip(0, 1) * 255).astype(np.uint8)]
    sh = ((colors / np.float32(255) - np.float32(0.5)) / np.float32(C0))[:, None]
    return _splats(baked, baked.opacities[THERMAL], sh.astype(np.float32))


def base_values(baked: BakedModel, modality: Modality) -> Float32[np.ndarray, "n c"]:
    """The part of each splat's values that does not depend on the view, [N, C]; temperatures in °C
    where the scene has a range."""
    return to_array(in_unit(modality, baked.base_values(modality), baked.temperature))


def value_names(baked: BakedModel, modality: Modality) -> list[str]:
    """Names of a modality's channels in files; not for RGB."""
    if modality == THERMAL:
        return [temperature_name(baked)]
    if modality.channels == 1:
        return [modality.name]
    return [f"{modality}_{channel}" for channel in range(modality.channels)]


def shown_temperatures(baked: BakedModel) -> Float32[np.ndarray, " n"]:
    """Temperature of each splat, [N], in °C; normalised where the scene has no °C."""
    return base_values(baked, THERMAL)[:, 0]


def temperature_name(baked: BakedModel) -> str:
    """Name of the temperatures in files: ``temperature_c``, or ``temperature_normalised`` where the
    scene has no °C."""
    return "temperature_normalised" if baked.temperature is None else "temperature_c"


def to_bytes(values: Float32[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Values in [0, 1], clamped, as 0 to 255."""
    return np.rint(values.clip(0, 1) * 255).astype(np.uint8)


def _splats(baked: BakedModel, opacity: Tensor, sh: Float32[np.ndarray, "n b 3"]) -> SplatArrays:
    rotations = torch.nn.functional.normalize(baked.quats, dim=1)
    means, quats, scales, opacities = (
        to_array(tensor) for tensor in (baked.means, rotations, baked.scales, opacity)
    )
    return SplatArrays(means, quats, scales, opacities, sh)
