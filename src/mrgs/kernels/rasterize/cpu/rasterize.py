"""The fused pass as a torch function: project, sort, list, blend; and backwards."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mrgs.kernels.rasterize import in_passes
from mrgs.kernels.rasterize.cpu.blend import blend
from mrgs.kernels.rasterize.cpu.blend_backward import blend_backward
from mrgs.kernels.rasterize.cpu.median import median
from mrgs.kernels.rasterize.cpu.projection import depth_slopes, project, project_backward
from mrgs.kernels.rasterize.cpu.tiles import (
    TileLists,
    depth_order,
    empty_splats,
    gather_splats,
    tile_lists,
)
from mrgs.kernels.require import require_camera
from mrgs.rasterizer import splat
from mrgs.rasterizer.contract import DILATION_PX2, Layer, Raster
from mrgs.scene import Blend
from mrgs.system.memory import CHUNK_ROWS, row_chunks

_SLOT_CHANNELS = (3, 1)
"""The kernels blend two slots at once: the first takes the layer of 3 channels, the second that of
1."""


class _Projection(NamedTuple):
    """What the kernels project with, in the order of their arguments.

    Attributes:
        viewmat, K: float64, [4, 4] and [3, 3].
        width, height: pixels.
        dilation_px2: of the projected covariances.
    """

    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int
    dilation_px2: float


class _FusedPass(torch.autograd.Function):
    """(means, quats, scales, opacities [N, 2], features [N, 4], backgrounds [4], offset [N, 2],
    projection, whether gradients are wanted) -> images, radii.

    The images are those of both slots: features, depth, T_end, features, depth, T_end.
    """

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, ...]:
        *tensors, projection, for_gradients = inputs
        tensors = [tensor.contiguous() for tensor in tensors]
        *gaussians, backgrounds, offset = (tensor.detach().numpy() for tensor in tensors)
        splats, lists, radii = _listed_splats(gaussians, projection, offset, for_gradients)
        height, width = projection.height, projection.width
        shapes = [
            shape
            for c in _SLOT_CHANNELS
            for shape in ((height, width, c), (height, width), (height, width))
        ]
        images = [np.empty(shape, np.float32) for shape in shapes]
        blend(
            splats, lists.tile_splats, lists.tile_starts, backgrounds[:3], backgrounds[3:], *images
        )
        *outputs, radii_tensor = (torch.from_numpy(array) for array in (*images, radii))
        ctx.mark_non_differentiable(radii_tensor)
        ctx.save_for_backward(*tensors[:5], *outputs)
        ctx.walk = (projection, splats, lists)
        return (*outputs, radii_tensor)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        saved = [tensor.detach().numpy() for tensor in ctx.saved_tensors]
        gaussians, images = saved[:5], saved[5:]
        projection, splats, lists = ctx.walk
        grad_images = [grad.contiguous().numpy() for grad in grads[:-1]]
        pair_grads = np.empty((lists.tile_splats.size, splat.GRAD_FLOATS), np.float32)
        blend_backward(
            splats, lists.tile_splats, lists.tile_starts, *images, *grad_images, pair_grads
        )
        means, quats, scales, opacities, _ = gaussians
        grad_gaussians = [np.empty_like(array) for array in gaussians]
        grad_offset = np.empty((means.shape[0], 2), np.float32)
        project_backward(
            means, quats, scales, opacities, *projection, pair_grads,
            lists.pair_positions, lists.pair_starts, *grad_gaussians, grad_offset,
        )  # fmt: skip
        # ∂L/∂background = Σ T_end g over the pixels. Not tensordot: BLAS threads spin on after it,
        # and cost the kernels half a core.
        grad_backgrounds = [
            np.einsum("hw,hwc->hc", images[k + 2], grad_images[k]).sum(axis=0) for k in (0, 3)
        ]
        grads_of_inputs = (*grad_gaussians, np.concatenate(grad_backgrounds), grad_offset)
        return (*(torch.from_numpy(grad) for grad in grads_of_inputs), None, None)


def _listed_splats(
    gaussians: Sequence[np.ndarray],
    projection: _Projection,
    offset: np.ndarray,
    for_gradients: bool,
) -> tuple[np.ndarray, TileLists, np.ndarray]:
    """The projected Gaussians in depth order [V, 16], the tiles' lists of them, and the radii [N].

    Args:
        gaussians: means, quats, scales, opacities [N, 2], features [N, 4].
        projection: into the image.
        offset: of the projected centres, [N, 2].
        for_gradients: whether the lists have the pairs of each Gaussian too.
    """
    count = gaussians[0].shape[0]
    if for_gradients:
        splats, radii = empty_splats(count), np.empty(count, np.float32)
        project(*gaussians, *projection, offset, splats, radii)
        is_drawn = radii > 0
    else:
        splats, radii = _drawn_splats(gaussians, projection, offset)
        is_drawn = np.ones(len(splats), np.bool_)
    order = depth_order(np.ascontiguousarray(splats[:, splat.DEPTH]), is_drawn)
    splats = gather_splats(splats, order)
    listed = count if for_gradients else 0
    lists = tile_lists(splats, order, listed, projection.width, projection.height)
    return splats, lists, radii


def _drawn_splats(
    gaussians: Sequence[np.ndarray],
    projection: _Projection,
    offset: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The projected Gaussians that are drawn, in the order of their indices [V, 16], and all
    radii [N]: less memory than records of all, from which no gradient finds its way back."""
    count = gaussians[0].shape[0]
    splats, radii = empty_splats(count), np.empty(count, np.float32)
    piece, drawn = empty_splats(min(count, CHUNK_ROWS)), 0
    for rows in row_chunks(count):
        projected = piece[: len(radii[rows])]
        arrays = [array[rows] for array in gaussians]
        project(*arrays, *projection, offset[rows], projected, radii[rows])
        found = projected[radii[rows] > 0]
        splats[drawn : drawn + len(found)] = found
        drawn += len(found)
    return splats[:drawn], radii


def median_depth(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    viewmat: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    width: int,
    height: int,
    dilation_px2: float = DILATION_PX2,
) -> Float[Tensor, "h w"]:
    """``reference.median_depth`` for float32 tensors on the CPU.

    Raises:
        ValueError: tensors of other types or sizes.
    """
    count = means.shape[0]
    both = torch.stack([opacities.detach(), opacities.new_zeros(count)], dim=1)
    features, offset = torch.zeros(count, 4), _zeros(count, 2)
    _check(means, quats, scales, both, features, means.new_zeros(4), offset)
    require_camera(viewmat, K, width, height)
    gaussians = [
        tensor.detach().contiguous().numpy() for tensor in (means, quats, scales, both, features)
    ]
    projection = _Projection(_float64(viewmat), _float64(K), width, height, dilation_px2)
    # The records have room for what is blended, and a depth needs none of it.
    depth_slopes(*gaussians[:3], *projection, gaussians[4])
    splats, lists, _ = _listed_splats(gaussians, projection, offset.numpy(), False)
    depth = np.empty((height, width), np.float32)
    median(splats, lists.tile_splats, lists.tile_starts, depth)
    return torch.from_numpy(depth)


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
    dilation_px2: float = DILATION_PX2,
) -> Raster:
    """``contract.Rasterizer`` for float32 tensors on the CPU.

    Raises:
        ValueError: no layer, or tensors of other types or sizes.
        MrgsError: the Gaussians reach more tiles, together, than the kernels can number.
    """
    offset = _zeros(means.shape[0], 2) if means2d_offset is None else means2d_offset
    require_camera(viewmat, K, width, height)
    projection = _Projection(_float64(viewmat), _float64(K), width, height, dilation_px2)
    return in_passes(layers, partial(_one_pass, means, quats, scales, offset, projection))


def _one_pass(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    offset: Tensor,
    projection: _Projection,
    layers: Sequence[Layer],
) -> Raster:
    """One layer of 3 or 1 channels, or one of each."""
    channels = [layer.features.shape[1] for layer in layers]
    inputs = (
        *(means, quats, scales),
        *_merge_layers(dict(zip(channels, layers, strict=True)), means.shape[0]),
        offset,
    )
    _check(*inputs)
    for_gradients = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs)
    *images, radii = _FusedPass.apply(*inputs, projection, for_gradients)
    blends = {3: _to_blend(*images[:3]), 1: _to_blend(*images[3:])}
    return Raster(tuple(blends[count] for count in channels), radii)


def _zeros(rows: int, columns: int) -> Tensor:
    """Zeros that are only read: numpy's take no memory until they are written, torch's do."""
    return torch.from_numpy(np.zeros((rows, columns), np.float32))


def _check(means: Tensor, *others: Tensor) -> None:
    """The kernels trust sizes and types, so nothing else may reach them."""
    count = means.shape[0]
    shapes = ((count, 3), (count, 4), (count, 3), (count, 2), (count, 4), (4,), (count, 2))
    for tensor, shape in zip((means, *others), shapes, strict=True):
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu" or tensor.shape != shape:
            raise ValueError(
                f"the CPU rasterizer takes float32 tensors of matching sizes; got {tensor.dtype} "
                f"{tuple(tensor.shape)} on {tensor.device.type} where {shape} is needed"
            )


def _to_blend(image: Tensor, depth: Tensor, transmittance: Tensor) -> Blend:
    return Blend(image, depth, 1 - transmittance)


def _float64(matrix: Tensor) -> np.ndarray:
    """Row by row in memory: the kernels are compiled for one layout."""
    return matrix.detach().double().contiguous().numpy()


def _merge_layers(by_channels: dict[int, Layer], count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Opacities [N, 2], features [N, 4], backgrounds [4] of both slots; a slot without a layer is
    transparent."""
    layers = [
        by_channels.get(channels)
        or Layer(torch.zeros(count), torch.zeros(count, channels), torch.zeros(channels))
        for channels in _SLOT_CHANNELS
    ]
    return (
        torch.stack([layer.opacities for layer in layers], dim=1),
        torch.cat([layer.features for layer in layers], dim=1),
        torch.cat([layer.background for layer in layers]),
    )
