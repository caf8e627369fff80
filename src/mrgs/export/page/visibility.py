"""How much of the photos each splat paints."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from mrgs.rasterizer import Layer, rasterize
from mrgs.runs.baked import BakedModel
from mrgs.scene import Camera, spread

VIEWS = 16
"""Cameras that are asked, evenly spread over those given."""

WIDTH_PX = 320


def blending_weights(baked: BakedModel, cameras: Sequence[Camera]) -> Float[Tensor, " n"]:
    """Σ w_i over the pixels of some of the views, of the modality in which the splat weighs more,
    [N].

    An image is linear in the features that it blends, so its gradient in them is the sum of the
    weights.
    """
    weights = torch.zeros(2, len(baked))
    for index in spread(len(cameras), VIEWS):
        small = cameras[index].with_width(WIDTH_PX)
        features = [torch.zeros(len(baked), channels, requires_grad=True) for channels in (3, 1)]
        opacities = (baked.opacity_rgb, baked.opacity_thermal)
        layers = [
            Layer(o, f, f.new_zeros(f.shape[1])) for o, f in zip(opacities, features, strict=True)
        ]
        raster = rasterize(
            baked.means, baked.quats, baked.scales, layers, small.viewmat, small.K, small.width,
            small.height,
        )  # fmt: skip
        total = torch.stack([blend.image[..., 0].sum() for blend in raster.blends]).sum()
        gradients = torch.autograd.grad(total, features)
        weights += torch.stack([gradient[:, 0] for gradient in gradients])
    return weights.max(dim=0).values


def most_visible(baked: BakedModel, cameras: Sequence[Camera], count: int) -> Int64[Tensor, " k"]:
    """The rows of the ``count`` splats with the largest weights, in ascending order; all rows if
    there are fewer."""
    if len(baked) <= count:
        return torch.arange(len(baked))
    return blending_weights(baked, cameras).topk(count).indices.sort().values
