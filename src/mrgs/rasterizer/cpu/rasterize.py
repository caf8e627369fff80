"""The fused pass as a torch function: project, sort, list, blend; and backwards."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.rasterizer.contract import Blend, Layer, Raster
from mrgs.rasterizer.cpu import blend as b
from mrgs.rasterizer.cpu import splat
from mrgs.rasterizer.cpu.blend_backward import blend_backward
from mrgs.rasterizer.cpu.projection import project, project_backward
from mrgs.rasterizer.cpu.tiles import depth_order, gather_rows, tile_lists

_RGB_SLOT, _THERMAL_SLOT = 0, 1
_SLOT_OF_CHANNELS = {3: _RGB_SLOT, 1: _THERMAL_SLOT}
_FEATURES_OF_SLOT = {_RGB_SLOT: slice(0, 3), _THERMAL_SLOT: slice(3, 4)}


class _FusedPass(torch.autograd.Function):
    """(means, quats, scales, opacities [N, 2], features [N, 4], backgrounds [4], offset) -> image [H, W, 8], radii."""

    @staticmethod
    def forward(ctx: Any, means, quats, scales, opacities, features, backgrounds, offset, viewmat, K, width, height):
        arrays = [tensor.detach().contiguous().numpy() for tensor in (means, quats, scales, opacities, features)]
        count = means.shape[0]
        splats = np.empty((count, splat.SPLAT_FLOATS), np.float32)
        radii = np.empty(count, np.float32)
        project(*arrays, viewmat, K, width, height, offset.detach().contiguous().numpy(), splats, radii)
        order = depth_order(np.ascontiguousarray(splats[:, splat.DEPTH]), radii > 0)
        splats = gather_rows(splats, order)
        lists = tile_lists(splats, width, height)
        image = np.empty((height, width, b.IMAGE_CHANNELS), np.float32)
        b.blend(splats, lists[0], lists[1], backgrounds.detach().contiguous().numpy(), image)
        ctx.saved = (arrays, viewmat, K, splats, order, lists, image)
        image_tensor, radii_tensor = torch.from_numpy(image), torch.from_numpy(radii)
        ctx.mark_non_differentiable(radii_tensor)
        return image_tensor, radii_tensor

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        grad_image = grads[0].contiguous()
        arrays, viewmat, K, splats, order, lists, image = ctx.saved
        means, quats, scales, opacities, features = arrays
        tile_splats, tile_starts, pair_positions, pair_starts = lists
        height, width = image.shape[:2]
        pair_grads = np.empty((tile_splats.size, splat.GRAD_FLOATS), np.float32)
        blend_backward(splats, tile_splats, tile_starts, image, grad_image.numpy(), pair_grads)
        offset = np.empty((means.shape[0], 2), np.float32)
        results = [np.zeros_like(array) for array in (means, quats, scales, opacities, features, offset)]
        project_backward(
            means, quats, scales, opacities, viewmat, K, width, height, splats, order, pair_grads, pair_positions,
            pair_starts, *results,
        )  # fmt: skip
        grad_means, grad_quats, grad_scales, grad_opacities, grad_features, grad_offset = map(torch.from_numpy, results)
        left_rgb = torch.from_numpy(1.0 - image[..., b.IMAGE_ALPHA_RGB, None])
        left_thermal = torch.from_numpy(1.0 - image[..., b.IMAGE_ALPHA_THERMAL, None])
        grad_backgrounds = torch.cat(
            [
                (grad_image[..., b.IMAGE_RGB] * left_rgb).sum(dim=(0, 1)),
                (grad_image[..., b.IMAGE_TEMPERATURE] * left_thermal).sum(dim=(0, 1)),
            ]
        )
        return (
            grad_means, grad_quats, grad_scales, grad_opacities, grad_features, grad_backgrounds, grad_offset,
            None, None, None, None,
        )  # fmt: skip


def rasterize(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    layers: Sequence[Layer],
    viewmat: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    width: int,
    height: int,
    means2d_offset: Float[Tensor, "n 2"] | None = None,
) -> Raster:
    """``contract.Rasterizer`` for float32 tensors on the CPU: one layer of 3 or 1 channels, or one of each, fused.

    Raises:
        ValueError: layers that are neither of these, or tensors that are not float32.
    """
    slots = [_SLOT_OF_CHANNELS.get(layer.features.shape[1]) for layer in layers]
    if None in slots or len(set(slots)) != len(slots) or not slots:
        raise ValueError("layers must be one of 3 channels, one of 1 channel, or one of each")
    if means.dtype != torch.float32:
        raise ValueError(f"the CPU rasterizer takes float32 tensors, not {means.dtype}")
    count = means.shape[0]
    opacities, features, backgrounds = _merge_layers(layers, slots, count)
    offset = means.new_zeros(count, 2) if means2d_offset is None else means2d_offset
    image, radii = _FusedPass.apply(
        means, quats, scales, opacities, features, backgrounds, offset,
        viewmat.detach().double().numpy(), K.detach().double().numpy(), width, height,
    )  # fmt: skip
    return Raster(tuple(_blend_of_slot(image, slot) for slot in slots), radii)


def _merge_layers(layers: Sequence[Layer], slots: list, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Opacities [N, 2], features [N, 4], backgrounds [4] of both slots; a slot without a layer is transparent."""
    by_slot = dict(zip(slots, layers, strict=True))
    empty = {
        _RGB_SLOT: Layer(torch.zeros(count), torch.zeros(count, 3), torch.zeros(3)),
        _THERMAL_SLOT: Layer(torch.zeros(count), torch.zeros(count, 1), torch.zeros(1)),
    }
    rgb, thermal = (by_slot.get(slot, empty[slot]) for slot in (_RGB_SLOT, _THERMAL_SLOT))
    return (
        torch.stack([rgb.opacities, thermal.opacities], dim=1),
        torch.cat([rgb.features, thermal.features], dim=1),
        torch.cat([rgb.background, thermal.background]),
    )


def _blend_of_slot(image: Float[Tensor, "h w 8"], slot: int) -> Blend:
    return Blend(
        image[..., _FEATURES_OF_SLOT[slot]],
        image[..., (b.IMAGE_DEPTH_RGB, b.IMAGE_DEPTH_THERMAL)[slot]],
        image[..., (b.IMAGE_ALPHA_RGB, b.IMAGE_ALPHA_THERMAL)[slot]],
    )
