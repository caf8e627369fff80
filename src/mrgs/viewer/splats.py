"""The model as plain splats for the browser's own renderer: smooth with a graphics
card."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from mrgs.pictures.files import shown_values, to_rgb8
from mrgs.pictures.values import full_scale
from mrgs.runs.baked import BakedModel
from mrgs.viewer.painting import Scales, isotherm_color
from mrgs.viewer.settings import Settings


class BrowserSplats:
    """The model as plain splats, baked on first use.

    Args:
        bake: makes the plain splats; may take seconds.
    """

    def __init__(self, bake: Callable[[], BakedModel]) -> None:
        self._bake = bake
        self._baked: BakedModel | None = None
        self._lock = threading.Lock()

    def baked(self) -> BakedModel:
        """The plain splats; the first call bakes them, which may take seconds."""
        with self._lock:
            if self._baked is None:
                self._baked = self._bake()
        return self._baked


def splat_colors(baked: BakedModel, settings: Settings, scales: Scales) -> UInt8[np.ndarray, "n 3"]:
    """One colour per splat for a mode of one modality: of its value by the modality's scale, or its
    mean colour over all directions."""
    (modality,) = settings.mode.modalities
    base = baked.base_values(modality)
    if modality.channels > 1:
        return to_rgb8(base[None])[0]
    values = shown_values(modality, base[None], baked.temperature)
    scale = scales.values.get(modality) or full_scale(modality, baked.temperature, settings.palette)
    palette = settings.palette if modality.is_metric else scale.palette
    colors = scale._replace(palette=palette).colorize(values)[0]
    if modality == settings.scaled and settings.isotherm is not None:
        band = (values[0] >= min(settings.isotherm)) & (values[0] <= max(settings.isotherm))
        colors[band] = isotherm_color(settings.palette)
    return colors


def covariances(
    quats: Float[Tensor, "n 4"], scales: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3 3"]:
    """Covariance R diag(s²) Rᵀ of each splat, [N, 3, 3], from quaternions wxyz and standard
    deviations s along the rotated axes."""
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
