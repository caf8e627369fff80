"""Pairs of neighbouring pixels that count in the total variation."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Bool, Float, Int64
from torch import Tensor


class Pairs(NamedTuple):
    """Pairs of pixels next to each other along one axis.

    Attributes:
        counted: how many count; a tensor where a mask decides.
        weights: 1 for those that count, else 0, [H − 1, W] between rows or [H, W − 1] between
            columns; None if all do.
    """

    counted: int | Int64[Tensor, ""]
    weights: Float[Tensor, "h2 w2"] | None


def valid_pairs(
    image: Float[Tensor, "h w c"], axis: int, valid: Bool[Tensor, "h w"] | None
) -> Pairs:
    """The pairs along an axis (0: between rows, 1: between columns) whose pixels are both valid."""
    height, width, _ = image.shape
    if valid is None:
        return Pairs((height - 1) * width if axis == 0 else height * (width - 1), None)
    steps = valid.shape[axis] - 1
    both = valid.narrow(axis, 0, steps) & valid.narrow(axis, 1, steps)
    return Pairs(both.sum(), both.to(image.dtype))
