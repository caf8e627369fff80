"""The fused pass as a torch function: project, sort, list, blend; and backwards.

The host waits for the device once, for the number of pairs of a tile and a Gaussian (8 bytes): it
sizes the lists, unless the pass is recorded (``mrgs.system.cuda_graph``). All else is queued. The
results are the same bits on every run.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mrgs.errors import MrgsError
from mrgs.kernels.gpu_spec import Arguments
from mrgs.kernels.rasterize import cpu, in_passes
from mrgs.kernels.rasterize.gpu import kernels
from mrgs.kernels.rasterize.gpu.constants import GRAD_FLOATS, SPLAT_FLOATS, TILE_HEIGHT, TILE_WIDTH
from mrgs.kernels.require import require_camera
from mrgs.rasterizer.contract import DILATION_PX2, Layer, Raster
from mrgs.scene import Blend
from mrgs.system.cuda_graph import room_of_list

_SLOTS = {3: "color", 1: "scalar"}
"""What the kernels call a layer, by its channels."""

_GEOMETRY = {"means": 3, "quats": 4, "scales": 3, "means2d_offset": 2}
"""Columns of the tensors that the layers share."""

_LAYER = ("opacities", "features", "background")
_IMAGES = ("image", "depth", "alpha")

_MOST_PAIRS = 2**31 - 2**16
"""The kernels number pairs with 32 bits, and the last program has numbers past the last pair."""

_MOST_GAUSSIANS = (2**31 - 2**16) // SPLAT_FLOATS.value
"""The kernels number the values of their records with 32 bits."""

_MOST_SHORT_TILES = 2**15 - 1
"""Largest number of tiles whose numbers (and one more) fit 16 bits, which are sorted in half the
time of 32."""


class _Pass(NamedTuple):
    """What a pass draws; ``channels`` by layer, in the order of the outputs."""

    channels: dict[str, int]
    width: int
    height: int
    dilation_px2: float

    @property
    def layers(self) -> str:
        """The layers as ``kernels`` calls them."""
        return "fused" if len(self.channels) == 2 else next(iter(self.channels))

    @property
    def tiles(self) -> int:
        return -(-self.width // TILE_WIDTH.value) * -(-self.height // TILE_HEIGHT.value)

    @property
    def inputs(self) -> list[str]:
        """Names of the differentiable tensors, in the order in which they are handed over."""
        return [*_GEOMETRY, *(f"{name}_{layer}" for layer in self.channels for name in _LAYER)]

    @property
    def outputs(self) -> list[str]:
        """Names of the images, in the order in which they are returned."""
        return [f"{name}_{layer}" for layer in self.channels for name in _IMAGES]


class _FusedPass(torch.autograd.Function):
    """(pass, viewmat, K, ``_Pass.inputs``) -> ``_Pass.outputs`` and the radii."""

    @staticmethod
    def forward(
        ctx: Any, what: _Pass, viewmat: Tensor, K: Tensor, *inputs: Tensor
    ) -> tuple[Tensor, ...]:
        buffers: Arguments = {
            "count": len(inputs[0]),
            "tiles": what.tiles,
            "width": what.width,
            "height": what.height,
            "dilation": what.dilation_px2,
        }
        sizes = dict(buffers)
        buffers |= {"viewmat": viewmat, "K": K}
        buffers |= {
            name: tensor.contiguous() for name, tensor in zip(what.inputs, inputs, strict=True)
        }
        with torch.cuda.device_of(inputs[0]):
            _project(what, buffers)
            _list(buffers)
            _blend(what, buffers)
        ctx.mark_non_differentiable(buffers["radii"])
        ctx.what, ctx.sizes, ctx.kept = (
            what,
            sizes,
            sorted(_needed_backward(what) & buffers.keys() - sizes.keys()),
        )
        ctx.save_for_backward(*(buffers[name] for name in ctx.kept))
        return (*(buffers[name] for name in what.outputs), buffers["radii"])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        what: _Pass = ctx.what
        buffers: Arguments = ctx.sizes | dict(zip(ctx.kept, ctx.saved_tensors, strict=True))
        for name, grad in zip(what.outputs, grads[:-1], strict=True):
            buffers[f"grad_{name}"] = grad.contiguous()
        with torch.cuda.device_of(grads[0]):
            _blend_backward(what, buffers)
            _project_backward(what, buffers)
        return None, None, None, *(buffers[f"grad_{name}"] for name in what.inputs)


def _needed_backward(what: _Pass) -> set[str]:
    backward = (
        kernels.BLEND_BACKWARD[what.layers],
        kernels.SUM_PAIRS,
        kernels.PROJECT_BACKWARD[what.layers],
    )
    return {name for spec in backward for name in spec.signature}


def _programs(items: int, per_program: int = kernels.BLOCK) -> tuple[int]:
    """The grid in which each program takes ``per_program`` items."""
    return (-(-items // per_program),)


def _project(what: _Pass, buffers: Arguments) -> None:
    """Add the records, radii, depths and numbers of pairs."""
    count, means = buffers["count"], buffers["means"]
    # One record at least: where there is nothing to draw, the blender still fetches the first
    # ahead.
    buffers["splats"] = means.new_empty(max(count, 1), SPLAT_FLOATS.value)
    buffers["radii"], buffers["depths"] = means.new_empty(count), means.new_empty(count)
    buffers["pair_counts"] = means.new_empty(count, dtype=torch.int32)
    kernels.PROJECT[what.layers].launch(_programs(count), buffers)


def _list(buffers: Arguments) -> None:
    """Add the lists of the tiles, and where each Gaussian's pairs stand: sort by depth, then stably
    by tile.

    Raises:
        MrgsError: there are more pairs than the kernels can number.
    """
    depths, tiles = buffers["depths"], buffers["tiles"]
    order = torch.argsort(depths, stable=True)
    pair_ends = torch.cumsum(
        buffers["pair_counts"].index_select(0, order), dim=0, dtype=torch.int64
    )
    pairs = room_of_list(pair_ends[-1:]) if len(pair_ends) else 0
    if pairs > _MOST_PAIRS:
        raise MrgsError(
            f"the Gaussians reach {pairs:,} tiles of the image together, and at most "
            f"{_MOST_PAIRS:,} can be drawn: "
            "render a smaller image, or fewer Gaussians"
        )
    pair_ends = pair_ends.clamp_max(pairs)  # where a recorded list has too little room
    dtype = torch.int16 if tiles <= _MOST_SHORT_TILES else torch.int32
    tile_of_pair = depths.new_empty(pairs, dtype=dtype)
    splat_of_pair = depths.new_empty(pairs, dtype=torch.int32)
    buffers |= {"order": order, "pair_ends": pair_ends, "pairs": pairs}
    given = buffers | {"tile_of_pair": tile_of_pair, "splat_of_pair": splat_of_pair}
    kernels.LIST_PAIRS[dtype].launch(_programs(pairs), given)
    tile_of_pair, tile_pairs = torch.sort(tile_of_pair, stable=True)
    every_tile = torch.arange(tiles + 1, dtype=dtype, device=depths.device)
    buffers["tile_starts"] = torch.searchsorted(tile_of_pair, every_tile, out_int32=True)
    buffers["tile_splats"] = splat_of_pair.index_select(0, tile_pairs)
    buffers["tile_pairs"] = tile_pairs


def _blend(what: _Pass, buffers: Arguments) -> None:
    """Add the images."""
    means, size = buffers["means"], (what.height, what.width)
    for layer, channels in what.channels.items():
        buffers[f"image_{layer}"] = means.new_empty(*size, channels)
        for name in ("depth", "alpha", "transmittance"):
            buffers[f"{name}_{layer}"] = means.new_empty(size)
    kernels.BLEND[what.layers].launch((what.tiles,), buffers)


def _blend_backward(what: _Pass, buffers: Arguments) -> None:
    """Add the gradients of the backgrounds, and the gradient moments of every Gaussian."""
    means, tile_pairs = buffers["means"], buffers["tile_pairs"]
    pair_grads = means.new_zeros(len(tile_pairs), GRAD_FLOATS.value)
    grad_backgrounds = means.new_empty(4, what.tiles)
    given = buffers | {"pair_grads": pair_grads, "grad_backgrounds": grad_backgrounds}
    kernels.BLEND_BACKWARD[what.layers].launch((what.tiles,), given)
    if "color" in what.channels:
        buffers["grad_background_color"] = grad_backgrounds[:3].sum(dim=1)
    if "scalar" in what.channels:
        buffers["grad_background_scalar"] = grad_backgrounds[3:].sum(dim=1)
    buffers["gaussian_grads"] = means.new_empty(buffers["count"], GRAD_FLOATS.value)
    kernels.SUM_PAIRS.launch(
        _programs(buffers["count"], kernels.RANKS), buffers | {"pair_grads": pair_grads}
    )


def _project_backward(what: _Pass, buffers: Arguments) -> None:
    """Add the gradients of the Gaussians' parameters."""
    shapes: dict[str, tuple[int, ...]] = {name: (columns,) for name, columns in _GEOMETRY.items()}
    for layer, channels in what.channels.items():
        shapes |= {f"opacities_{layer}": (), f"features_{layer}": (channels,)}
    for name, shape in shapes.items():
        buffers[f"grad_{name}"] = buffers["means"].new_empty(buffers["count"], *shape)
    kernels.PROJECT_BACKWARD[what.layers].launch(_programs(buffers["count"]), buffers)


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
    """``reference.median_depth`` for float32 tensors on a GPU, computed by the host: no training
    needs it."""
    found: Tensor = cpu.median_depth(
        means.detach().cpu(), quats.detach().cpu(), scales.detach().cpu(),
        opacities.detach().cpu(), viewmat.cpu(), K.cpu(), width, height, dilation_px2,
    )  # fmt: skip
    return found.to(means.device)


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
    """``contract.Rasterizer`` for float32 tensors on a GPU.

    The camera may lie on any device; where it is not on that of ``means`` it is copied there.

    Raises:
        ValueError: no layer, or tensors of other types, sizes or devices.
        MrgsError: there are more Gaussians, or they reach more tiles together, than the kernels can
            number.
    """
    if len(means) > _MOST_GAUSSIANS:
        raise MrgsError(
            f"there are {len(means):,} Gaussians, and a GPU can draw at most "
            f"{_MOST_GAUSSIANS:,}: use the CPU"
        )
    require_camera(viewmat, K, width, height)
    offset = means.new_zeros(len(means), 2) if means2d_offset is None else means2d_offset
    # Not blocking: the host would wait for all that is queued. The copy has left a CPU tensor
    # before the call returns.
    viewmat, K = (
        matrix.detach().to(means, non_blocking=means.is_cuda).contiguous()
        for matrix in (viewmat, K)
    )

    def one_pass(layers: Sequence[Layer]) -> Raster:
        channels = [layer.features.shape[1] for layer in layers]
        what = _Pass({_SLOTS[c]: c for c in channels}, width, height, dilation_px2)
        inputs = [means, quats, scales, offset, *(tensor for layer in layers for tensor in layer)]
        _check(inputs, channels)
        outputs = _FusedPass.apply(what, viewmat, K, *inputs)
        return Raster(
            tuple(Blend(*outputs[i : i + 3]) for i in range(0, 3 * len(channels), 3)), outputs[-1]
        )

    return in_passes(layers, one_pass)


def _check(inputs: Sequence[Tensor], channels: Sequence[int]) -> None:
    """The kernels trust sizes, types and devices, so nothing else may reach them."""
    count, device = len(inputs[0]), inputs[0].device
    shapes: list[tuple[int, ...]] = [(count, columns) for columns in _GEOMETRY.values()]
    for c in channels:
        shapes += [(count,), (count, c), (c,)]
    for tensor, shape in zip(inputs, shapes, strict=True):
        if tensor.dtype != torch.float32 or tensor.device != device or tensor.shape != shape:
            raise ValueError(
                f"the GPU rasterizer takes float32 tensors of matching sizes on one device; got "
                f"{tensor.dtype} "
                f"{tuple(tensor.shape)} on {tensor.device} where {shape} on {device} is needed"
            )
