"""Alpha blending of projected Gaussians: layers of any number of channels, by passes of few."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import zip_longest

import torch
from torch import Tensor

from mrgs.kernels.require import require
from mrgs.rasterizer.contract import Geometry, Layer, Projection, Raster
from mrgs.scene import Blend


def require_pass(
    geometry: Geometry, layers: Sequence[Layer], projection: Projection, offset: Tensor
) -> None:
    """Check sizes, types and devices, which the kernels trust; ValueError if they do not fit."""
    count, device = len(geometry.means), geometry.means.device
    expected = {"means": 3, "quats": 4, "scales": 3, "means2d_offset": 2}
    for (name, columns), tensor in zip(expected.items(), (*geometry, offset), strict=True):
        require(name, tensor, (count, columns), device=device)
    for opacities, features, background in layers:
        require("opacities", opacities, (count,), device=device)
        require("features", features, (count, None), device=device)
        require("background", background, features.shape[1:], device=device)
    viewmat, K, width, height, _ = projection
    if viewmat.shape != (4, 4) or K.shape != (3, 3) or min(width, height) < 1:
        raise ValueError(
            f"a camera has a viewmat [4, 4], a K [3, 3] and pixels, not {list(viewmat.shape)}, "
            f"{list(K.shape)} and {width}×{height}"
        )


GROUP = 3
"""Channels that a pass blends in its first slot; its second one takes a single channel."""


def in_passes(layers: Sequence[Layer], draw: Callable[[Sequence[Layer]], Raster]) -> Raster:
    """Render layers, their channels in groups of 3 and 1, as many at once as possible; ``draw``
    renders one of either or both. ValueError if there is no layer, or one has no channel."""
    channels = [layer.features.shape[1] for layer in layers]
    if not channels or min(channels) < 1:
        raise ValueError("there must be a layer, and each must have a channel")
    if sorted(channels) in ([1], [GROUP], [1, GROUP]):
        return draw(layers)
    threes, ones = [], []
    for number, count in enumerate(channels):
        whole = count - count % GROUP
        threes += [(number, slice(first, first + GROUP)) for first in range(0, whole, GROUP)]
        ones += [(number, slice(first, first + 1)) for first in range(whole, count)]
    groups: dict[tuple[int, int], Blend] = {}
    radii = []
    for pair in zip_longest(threes, ones):
        drawn = [group for group in pair if group is not None]
        raster = draw([_group(layers[number], columns) for number, columns in drawn])
        radii.append(raster.radii)
        for (number, columns), blend in zip(drawn, raster.blends, strict=True):
            groups[number, columns.start] = blend
    blends = [
        [groups[key] for key in sorted(groups) if key[0] == number] for number in range(len(layers))
    ]
    return Raster(
        tuple(
            Blend(torch.cat([each.image for each in parts], dim=-1), parts[0].depth, parts[0].alpha)
            for parts in blends
        ),
        torch.stack(radii).amax(dim=0),
    )


def _group(layer: Layer, columns: slice) -> Layer:
    return Layer(layer.opacities, layer.features[:, columns], layer.background[columns])
