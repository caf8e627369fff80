"""The object of a thermal photo, parted from what lies around it, for the error on the object
alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.evaluation.metrics import otsu_threshold
from mrgs.scene import THERMAL, Pixels, View

BORDER = 0.05
"""Width of the border that the background reaches, as a share of each side."""


@dataclass(frozen=True)
class Foreground:
    """Which temperatures are the object's.

    Attributes:
        threshold: between object and background, normalised temperature.
        is_warm: whether the object is what is warmer; an ice cup is not.
    """

    threshold: float
    is_warm: bool

    @classmethod
    def find(cls, views: Sequence[View]) -> Foreground | None:
        """The foreground of a set of thermal photos.

        The threshold is Otsu's of each photo's valid pixels, averaged over the photos. Of both
        sides the object is the one that covers less of the photos' borders: an object is
        photographed as a whole, from all around.

        Args:
            views: those without a thermal photo are left out.

        Returns:
            None where no photo has a threshold: no thermal photos, or only uniform ones.
        """
        found, borders = [], []
        for view in views:
            if THERMAL not in view.images:
                continue
            photo = view.images[THERMAL].load()  # one at a time: there may be hundreds
            values = valid_values(photo)
            threshold = otsu_threshold(values.numpy()) if len(values) else None
            found += [] if threshold is None else [threshold]
            borders.append(valid_values(photo, border_of(photo)))
        if not found:
            return None
        threshold, border = float(np.mean(found)), torch.cat(borders)
        at_border = (border > threshold).double().mean().item() if len(border) else 0.0
        return cls(threshold, is_warm=at_border <= 0.5)

    def of(self, photo: Pixels) -> Bool[Tensor, "h w"]:
        """The valid pixels that belong to the object."""
        warm = photo.values[..., 0] > self.threshold
        mask = warm if self.is_warm else ~warm
        return mask if photo.valid is None else mask & photo.valid


def border_of(photo: Pixels) -> Bool[Tensor, "h w"]:
    """The pixels along the four sides, ``BORDER`` of a side wide and at least one pixel."""
    height, width = photo.values.shape[:2]
    rows, columns = max(1, round(BORDER * height)), max(1, round(BORDER * width))
    border = torch.ones(height, width, dtype=torch.bool)
    border[rows:-rows, columns:-columns] = False
    return border


def valid_values(photo: Pixels, among: Bool[Tensor, "h w"] | None = None) -> Float[Tensor, " n"]:
    """Normalised temperatures of the valid pixels, or of those among some."""
    chosen = torch.ones(photo.values.shape[:2], dtype=torch.bool) if among is None else among
    if photo.valid is not None:
        chosen = chosen & photo.valid
    return photo.values[..., 0][chosen]
