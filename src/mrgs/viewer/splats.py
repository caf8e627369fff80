"""The model as plain splats for the browser's own renderer: smooth where there is a graphics
card."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from mrgs.field.spherical_harmonics import C0
from mrgs.pictures.palette import colorize
from mrgs.runs.baked import BakedModel
from mrgs.scene import RGB
from mrgs.viewer.painting import Scales, isotherm_color
from mrgs.viewer.settings import Settings


class BrowserSplats:
    """Bakes the model when it is first asked for.

    Args:
        bake: makes the plain splats; may take seconds.
    """

    def __init__(self, bake: Callable[[], BakedModel]) -> None:
        self._bake = bake
        self._baked: BakedModel | None = None
        self._lock = threading.Lock()

    def baked(self) -> BakedModel:
        """The plain splats; the first call takes its time."""
        with self._lock:
            if self._baked is None:
                self._baked = self._bake()
        return self._baked


def splat_colors(baked: BakedModel, settings: Settings, scales: Scales) -> UInt8[np.ndarray, "n 3"]:
    """One colour per splat: of its temperature by the palette, or its mean colour over all
    directions."""
    if settings.mode != "temperature":
        return np.rint((baked.sh[RGB][:, 0] * C0 + 0.5).clamp(0, 1).numpy() * 255).astype(np.uint8)
    values = (baked.temperatures if baked.temperature is None else baked.temperatures_c).numpy()
    low, high = (0.0, 1.0) if scales.thermal is None else (scales.thermal.low, scales.thermal.high)
    colors = colorize(values[None], low, high, settings.palette)[0]
    if settings.isotherm is not None:
        band = (values >= min(settings.isotherm)) & (values <= max(settings.isotherm))
        colors[band] = isotherm_color(settings.palette)
    return colors


def covariances(
    quats: Float[Tensor, "n 4"], scales: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3 3"]:
    """R diag(s²) Rᵀ of each splat."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(dim=1)
    rotation = torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        dim=1,
    ).reshape(-1, 3, 3)  # fmt: skip
    axes = rotation * scales[:, None, :]
    return axes @ axes.mT
