"""The share of the photos that each splat covers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from mrgs.runs.baked import BakedModel
from mrgs.scene import Camera, evenly_spaced

VIEWS = 16
"""Number of cameras that are rendered, evenly spaced over those given."""

WIDTH_PX = 320


def blending_weights(baked: BakedModel, cameras: Sequence[Camera]) -> Float[Tensor, " n"]:
    """Σ w_i over the pixels of some of the views, of the modality in which the splat weighs more,
    [N].

    An image is linear in the features that it blends, so its gradient in them is the sum of the
    weights.
    """
    weights = torch.zeros(len(baked.modalities), len(baked))
    for index in evenly_spaced(len(cameras), VIEWS):
        small = cameras[index].with_width(WIDTH_PX)
        features = {
            modality: torch.zeros(len(baked), modality.channels, requires_grad=True)
            for modality in baked.modalities
        }
        rendering = baked.blend(features, dict.fromkeys(baked.modalities, small))
        total = torch.stack([blend.image[..., 0].sum() for blend in rendering.values()]).sum()
        gradients = torch.autograd.grad(total, list(features.values()))
        weights += torch.stack([gradient[:, 0] for gradient in gradients])
    return weights.max(dim=0).values


def most_visible(baked: BakedModel, cameras: Sequence[Camera], count: int) -> Int64[Tensor, " k"]:
    """The rows of the ``count`` splats with the largest weights, in ascending order; all rows if
    there are fewer."""
    if len(baked) <= count:
        return torch.arange(len(baked))
    return blending_weights(baked, cameras).topk(count).indices.sort().values
