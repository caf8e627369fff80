"""The fused pass as a torch function: project, sort, list, blend; and backwards."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mrgs.kernels.rasterize import in_passes, require_pass
from mrgs.kernels.rasterize.cpu.blend import LayerImages, blend, blend_backward, median
from mrgs.kernels.rasterize.cpu.projection import (
    GaussianArrays,
    depth_slopes,
    project,
    project_backward,
)
from mrgs.kernels.rasterize.cpu.tiles import (
    TileLists,
    empty_splats,
    gather_splats,
    nearest_first,
    tile_lists,
)
from mrgs.rasterizer import splat
from mrgs.rasterizer.contract import Geometry, Layer, Projection, Raster
from mrgs.scene import Blend
from mrgs.system.memory import CHUNK_ROWS, row_chunks

_SLOT_CHANNELS = (3, 1)
"""The kernels blend two slots at once: first the layer of 3 channels, then that of 1."""


class _FusedPass(torch.autograd.Function):
    """(means, quats, scales, opacities [N, 2], features [N, 4], backgrounds [4], offset [N, 2],
    projection, whether gradients are wanted) -> images (features, depth, T_end of both), radii."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, ...]:
        *tensors, projection, for_gradients = inputs
        tensors = [tensor.contiguous() for tensor in tensors]
        *gaussians, backgrounds, offset = (tensor.detach().numpy() for tensor in tensors)
        splats, lists, radii = _listed_splats(
            GaussianArrays(*gaussians), projection, offset, for_gradients
        )
        size = projection.height, projection.width
        images = [
            LayerImages(*(np.empty(shape, np.float32) for shape in ((*size, channels), size, size)))
            for channels in _SLOT_CHANNELS
        ]
        blend(splats, lists.tile_splats, lists.tile_starts, backgrounds, *images)
        arrays = (*images[0], *images[1], radii)
        *outputs, radii_tensor = (torch.from_numpy(array) for array in arrays)
        ctx.mark_non_differentiable(radii_tensor)
        ctx.save_for_backward(*tensors[:5], *outputs)
        ctx.walk = (projection, splats, lists)
        return (*outputs, radii_tensor)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        saved = [tensor.detach().numpy() for tensor in ctx.saved_tensors]
        gaussians, images = GaussianArrays(*saved[:5]), _by_slot(saved[5:])
        grad_images = _by_slot([grad.contiguous().numpy() for grad in grads[:-1]])
        projection, splats, lists = ctx.walk
        pair_grads = np.empty((lists.tile_splats.size, splat.GRAD_FLOATS), np.float32)
        blend_backward(
            splats, lists.tile_splats, lists.tile_starts, *images, *grad_images, pair_grads
        )
        grad_gaussians = GaussianArrays(*(np.empty_like(array) for array in gaussians))
        grad_offset = np.empty((len(gaussians.means), 2), np.float32)
        project_backward(
            gaussians, projection, pair_grads, lists.pair_positions, lists.pair_starts,
            grad_gaussians, grad_offset,
        )  # fmt: skip
        # ∂L/∂background = Σ T_end g over the pixels. Not tensordot: BLAS threads spin on after it,
        # and cost the kernels half a core.
        grad_backgrounds = [
            np.einsum("hw,hwc->hc", slot.transmittance, grad.image).sum(axis=0)
            for slot, grad in zip(images, grad_images, strict=True)
        ]
        grads_of_inputs = (*grad_gaussians, np.concatenate(grad_backgrounds), grad_offset)
        return (*(torch.from_numpy(grad) for grad in grads_of_inputs), None, None)


def _by_slot(arrays: Sequence[np.ndarray]) -> tuple[LayerImages, LayerImages]:
    return LayerImages(*arrays[:3]), LayerImages(*arrays[3:])


def _listed_splats(
    gaussians: GaussianArrays, projection: Projection, offset: np.ndarray, for_gradients: bool
) -> tuple[np.ndarray, TileLists, np.ndarray]:
    """The projected Gaussians nearest first [V, 16], the tiles' lists of them, with the pairs of
    each Gaussian where gradients are wanted, and the radii [N]. ``offset`` [N, 2] is that of the
    projected centres."""
    count = len(gaussians.means)
    if for_gradients:
        splats, radii = empty_splats(count), np.empty(count, np.float32)
        project(gaussians, projection, offset, splats, radii)
        is_drawn = radii > 0
    else:
        splats, radii = _drawn_splats(gaussians, projection, offset)
        is_drawn = np.ones(len(splats), np.bool_)
    order = nearest_first(np.ascontiguousarray(splats[:, splat.DISTANCE]), is_drawn)
    splats = gather_splats(splats, order)
    listed = count if for_gradients else 0
    lists = tile_lists(splats, order, listed, projection.width, projection.height)
    return splats, lists, radii


def _drawn_splats(
    gaussians: GaussianArrays, projection: Projection, offset: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The projected Gaussians that are drawn, in the order of their indices [V, 16], and all
    radii [N]: less memory than records of all, from which no gradient finds its way back."""
    count = len(gaussians.means)
    splats, radii = empty_splats(count), np.empty(count, np.float32)
    chunk, drawn = empty_splats(min(count, CHUNK_ROWS)), 0
    for rows in row_chunks(count):
        projected = chunk[: len(radii[rows])]
        arrays = GaussianArrays(*(array[rows] for array in gaussians))
        project(arrays, projection, offset[rows], projected, radii[rows])
        found = projected[radii[rows] > 0]
        splats[drawn : drawn + len(found)] = found
        drawn += len(found)
    return splats[:drawn], radii


def median_depth(
    geometry: Geometry, opacities: Float[Tensor, " n"], projection: Projection
) -> Float[Tensor, "h w"]:
    """``reference.median_depth`` for float32 on the CPU. ValueError for other types or sizes."""
    # The records have room for what is blended, and a depth needs none of it.
    features, offset = torch.zeros(len(opacities), 4), _zeros(len(opacities), 2)
    require_pass(geometry, [Layer(opacities, features, torch.zeros(4))], projection, offset)
    both = torch.stack([opacities, torch.zeros_like(opacities)], dim=1)
    gaussians = GaussianArrays(
        *(tensor.detach().contiguous().numpy() for tensor in (*geometry, both, features))
    )
    projection = _on_host(projection)
    depth_slopes(gaussians, projection)
    splats, lists, _ = _listed_splats(gaussians, projection, offset.numpy(), False)
    depth = np.empty((projection.height, projection.width), np.float32)
    median(splats, lists.tile_splats, lists.tile_starts, depth)
    return torch.from_numpy(depth)


def rasterize(
    geometry: Geometry,
    layers: Sequence[Layer],
    projection: Projection,
    means2d_offset: Float[Tensor, "n 2"] | None = None,
) -> Raster:
    """``reference.rasterize`` for float32 tensors on the CPU. ValueError for no layer, or tensors
    of other types or sizes; MrgsError if the Gaussians reach too many tiles to number."""
    count = len(geometry.means)
    offset = _zeros(count, 2) if means2d_offset is None else means2d_offset
    require_pass(geometry, layers, projection, offset)
    projection = _on_host(projection)

    def one_pass(layers: Sequence[Layer]) -> Raster:
        channels = [layer.features.shape[1] for layer in layers]
        given = dict(zip(channels, layers, strict=True))
        slots = [given.get(c) or _transparent(count, c) for c in _SLOT_CHANNELS]
        opacities, features, backgrounds = zip(*slots, strict=True)
        merged = torch.stack(opacities, dim=1), torch.cat(features, dim=1), torch.cat(backgrounds)
        inputs = (*geometry, *merged, offset)
        for_gradients = torch.is_grad_enabled() and any(each.requires_grad for each in inputs)
        *images, radii = _FusedPass.apply(*inputs, projection, for_gradients)
        blends = {3: _to_blend(*images[:3]), 1: _to_blend(*images[3:])}
        return Raster(tuple(blends[count] for count in channels), radii)

    return in_passes(layers, one_pass)


def _transparent(count: int, channels: int) -> Layer:
    """What a slot without a layer blends."""
    return Layer(torch.zeros(count), torch.zeros(count, channels), torch.zeros(channels))


def _zeros(rows: int, columns: int) -> Tensor:
    """Zeros that are only read: numpy's take no memory until they are written, torch's do."""
    return torch.from_numpy(np.zeros((rows, columns), np.float32))


def _to_blend(image: Tensor, depth: Tensor, transmittance: Tensor) -> Blend:
    return Blend(image, depth, 1 - transmittance)


def _on_host(projection: Projection) -> Any:
    """The projection as float64 arrays, row by row: the kernels are compiled for one layout."""
    return projection._replace(
        **{
            name: getattr(projection, name).detach().double().contiguous().numpy()
            for name in ("viewmat", "K")
        }
    )
