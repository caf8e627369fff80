"""Some of the Gaussians, and where they lie as seen from a camera."""

from __future__ import annotations

from jaxtyping import Float, Int64, Shaped
from torch import Tensor, nn


def take(
    tensor: Shaped[Tensor, "n ..."], rows: Int64[Tensor, " v"] | None
) -> Shaped[Tensor, "v ..."]:
    """The given rows of a tensor; all of it if None."""
    return tensor if rows is None else tensor.index_select(0, rows)


def viewing_directions(
    means: Float[Tensor, "n 3"], camera_position: Float[Tensor, "3"]
) -> Float[Tensor, "n 3"]:
    """Unit vectors from the camera to the Gaussians."""
    return nn.functional.normalize(means - camera_position, dim=1)
