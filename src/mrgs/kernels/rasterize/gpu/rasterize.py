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
from mrgs.kernels.gpu_spec import Arguments, KernelSpec, specialised
from mrgs.kernels.rasterize import in_passes, require_pass
from mrgs.kernels.rasterize.cpu import rasterize as cpu
from mrgs.kernels.rasterize.gpu.blend import blend, blend_backward, sum_pairs
from mrgs.kernels.rasterize.gpu.constants import GRAD_FLOATS, SPLAT_FLOATS, TILE_HEIGHT, TILE_WIDTH
from mrgs.kernels.rasterize.gpu.projection import project, project_backward
from mrgs.kernels.rasterize.gpu.tiles import list_pairs
from mrgs.rasterizer.contract import Geometry, Layer, Projection, Raster
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
"""Most tiles whose numbers (and one more) fit 16 bits, sorted in half the time of 32."""


LEFT_OUT = {"fused": None, "color": "scalar", "scalar": "color"}
"""The layers that a pass may have, and which layer it then lacks."""

BLOCK = 128
"""Gaussians, or pairs, of one program: one per thread."""

RANKS = 4
PAIRS = 16
"""Ranks of one program of ``sum_pairs``, and pairs of each that it adds in one turn."""

_TYPES = {
    "pair_counts": "*i32", "splat_of_pair": "*i32", "tile_splats": "*i32", "tile_starts": "*i32",
    "order": "*i64", "pair_ends": "*i64", "tile_pairs": "*i64",
    "count": "i32", "pairs": "i32", "tiles": "i32", "width": "i32", "height": "i32",
    "dilation": "fp32",
}  # fmt: skip
"""Types of the arguments, by name; all others are tensors of float32."""


def _spec(kernel: Any, variant: str, num_warps: int, constants: dict[str, Any]) -> KernelSpec:
    """An entry; of one stage: there are no loads that Triton could fetch ahead of the walks."""
    return specialised(kernel, constants, _TYPES, num_warps, 1, variant)


def _layer_constants(kernel: Any, layers: str) -> dict[str, Any]:
    """Which layers the specialisation has; the tensors of one that it lacks are None."""
    left_out = LEFT_OUT[layers]
    tensors = {
        name: None for name in kernel.arg_names if left_out and name.endswith(f"_{left_out}")
    }
    return {"HAS_COLOR": left_out != "color", "HAS_SCALAR": left_out != "scalar", **tensors}


def _by_layers(kernel: Any, num_warps: int, **constants: int) -> dict[str, KernelSpec]:
    """The entries of a kernel, by layers."""
    return {
        layers: _spec(kernel, layers, num_warps, _layer_constants(kernel, layers) | constants)
        for layers in LEFT_OUT
    }


PROJECT = _by_layers(project, BLOCK // 32, BLOCK=BLOCK)  # one Gaussian per thread
LIST_PAIRS = {
    dtype: specialised(
        list_pairs, {"BLOCK": BLOCK}, _TYPES | {"tile_of_pair": f"*{name}"}, BLOCK // 32, 1, name
    )
    for dtype, name in ((torch.int16, "i16"), (torch.int32, "i32"))
}
BLEND = _by_layers(blend, 1)  # one warp per tile
BLEND_BACKWARD = _by_layers(blend_backward, 1)
SUM_PAIRS = _spec(sum_pairs, "", 1, {"RANKS": RANKS, "PAIRS": PAIRS})
PROJECT_BACKWARD = _by_layers(project_backward, BLOCK // 32, BLOCK=BLOCK)

KERNELS: tuple[KernelSpec, ...] = (
    *PROJECT.values(),
    *LIST_PAIRS.values(),
    *BLEND.values(),
    *BLEND_BACKWARD.values(),
    SUM_PAIRS,
    *PROJECT_BACKWARD.values(),
)
"""Every specialisation that is launched, with the constants of its launch: the launches read these
entries, so that what is compiled ahead of time is what runs."""


class _Pass(NamedTuple):
    """What a pass draws; ``channels`` by layer, in the order of the outputs."""

    channels: dict[str, int]
    width: int
    height: int
    dilation_px2: float

    @property
    def layers(self) -> str:
        """The layers as ``LEFT_OUT`` calls them."""
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
        sizes: Arguments = {
            "count": len(inputs[0]), "tiles": what.tiles, "width": what.width,
            "height": what.height, "dilation": what.dilation_px2,
        }  # fmt: skip
        given = zip(what.inputs, inputs, strict=True)
        buffers = sizes | {"viewmat": viewmat, "K": K}
        buffers |= {name: tensor.contiguous() for name, tensor in given}
        with torch.cuda.device_of(inputs[0]):
            _project(what, buffers)
            _list(buffers)
            _blend(what, buffers)
        ctx.mark_non_differentiable(buffers["radii"])
        backward = BLEND_BACKWARD[what.layers], SUM_PAIRS, PROJECT_BACKWARD[what.layers]
        needed = {name for spec in backward for name in spec.signature}
        ctx.what, ctx.sizes = what, sizes
        ctx.kept = sorted(needed & buffers.keys() - sizes.keys())
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


def _programs(items: int, per_program: int = BLOCK) -> tuple[int]:
    """The grid in which each program takes ``per_program`` items."""
    return (-(-items // per_program),)


def _project(what: _Pass, buffers: Arguments) -> None:
    """Add the records, radii, distances and numbers of pairs."""
    count, means = buffers["count"], buffers["means"]
    # One record at least: where there is nothing to draw, the blender still fetches the first
    # ahead.
    buffers["splats"] = means.new_empty(max(count, 1), SPLAT_FLOATS.value)
    buffers["radii"], buffers["distances"] = means.new_empty(count), means.new_empty(count)
    buffers["pair_counts"] = means.new_empty(count, dtype=torch.int32)
    PROJECT[what.layers].launch(_programs(count), buffers)


def _list(buffers: Arguments) -> None:
    """Add the lists of the tiles, and where each Gaussian's pairs are: sort by distance, then
    stably by tile. MrgsError if there are more pairs than the kernels can number."""
    distances, tiles = buffers["distances"], buffers["tiles"]
    order = torch.argsort(distances, stable=True)
    counts = buffers["pair_counts"].index_select(0, order)
    pair_ends = torch.cumsum(counts, dim=0, dtype=torch.int64)
    pairs = room_of_list(pair_ends[-1:]) if len(pair_ends) else 0
    if pairs > _MOST_PAIRS:
        raise MrgsError(
            f"the Gaussians reach {pairs:,} tiles of the image together, and at most "
            f"{_MOST_PAIRS:,} can be drawn: render a smaller image, or fewer Gaussians"
        )
    pair_ends = pair_ends.clamp_max(pairs)  # where a recorded list has too little room
    dtype = torch.int16 if tiles <= _MOST_SHORT_TILES else torch.int32
    tile_of_pair = distances.new_empty(pairs, dtype=dtype)
    splat_of_pair = distances.new_empty(pairs, dtype=torch.int32)
    buffers |= {"order": order, "pair_ends": pair_ends, "pairs": pairs}
    given = buffers | {"tile_of_pair": tile_of_pair, "splat_of_pair": splat_of_pair}
    LIST_PAIRS[dtype].launch(_programs(pairs), given)
    tile_of_pair, tile_pairs = torch.sort(tile_of_pair, stable=True)
    every_tile = torch.arange(tiles + 1, dtype=dtype, device=distances.device)
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
    BLEND[what.layers].launch((what.tiles,), buffers)


def _blend_backward(what: _Pass, buffers: Arguments) -> None:
    """Add the gradients of the backgrounds, and the gradient moments of every Gaussian."""
    means, tile_pairs = buffers["means"], buffers["tile_pairs"]
    pair_grads = means.new_zeros(len(tile_pairs), GRAD_FLOATS.value)
    grad_backgrounds = means.new_empty(4, what.tiles)
    given = buffers | {"pair_grads": pair_grads, "grad_backgrounds": grad_backgrounds}
    BLEND_BACKWARD[what.layers].launch((what.tiles,), given)
    if "color" in what.channels:
        buffers["grad_background_color"] = grad_backgrounds[:3].sum(dim=1)
    if "scalar" in what.channels:
        buffers["grad_background_scalar"] = grad_backgrounds[3:].sum(dim=1)
    buffers["gaussian_grads"] = means.new_empty(buffers["count"], GRAD_FLOATS.value)
    SUM_PAIRS.launch(_programs(buffers["count"], RANKS), buffers | {"pair_grads": pair_grads})


def _project_backward(what: _Pass, buffers: Arguments) -> None:
    """Add the gradients of the Gaussians' parameters."""
    shapes: dict[str, tuple[int, ...]] = {name: (columns,) for name, columns in _GEOMETRY.items()}
    for layer, channels in what.channels.items():
        shapes |= {f"opacities_{layer}": (), f"features_{layer}": (channels,)}
    for name, shape in shapes.items():
        buffers[f"grad_{name}"] = buffers["means"].new_empty(buffers["count"], *shape)
    PROJECT_BACKWARD[what.layers].launch(_programs(buffers["count"]), buffers)


def median_depth(
    geometry: Geometry, opacities: Float[Tensor, " n"], projection: Projection
) -> Float[Tensor, "h w"]:
    """``reference.median_depth`` for float32 on a GPU, by the host: no training needs it."""
    on_host = Geometry(*(tensor.detach().cpu() for tensor in geometry))
    projection = projection._replace(viewmat=projection.viewmat.cpu(), K=projection.K.cpu())
    found: Tensor = cpu.median_depth(on_host, opacities.detach().cpu(), projection)
    return found.to(opacities.device)


def rasterize(
    geometry: Geometry,
    layers: Sequence[Layer],
    projection: Projection,
    means2d_offset: Float[Tensor, "n 2"] | None = None,
) -> Raster:
    """``reference.rasterize`` for float32 tensors on a GPU, to which the camera is copied if need
    be. ValueError for no layer, or tensors of other types, sizes or devices; MrgsError if there are
    more Gaussians, or they reach more tiles together, than the kernels can number."""
    means = geometry.means
    if len(means) > _MOST_GAUSSIANS:
        raise MrgsError(
            f"there are {len(means):,} Gaussians, and a GPU can draw at most "
            f"{_MOST_GAUSSIANS:,}: use the CPU"
        )
    offset = means.new_zeros(len(means), 2) if means2d_offset is None else means2d_offset
    require_pass(geometry, layers, projection, offset)
    # Not blocking: the host would wait for all that is queued. The copy has left a CPU tensor
    # before the call returns.
    viewmat, K = (
        matrix.detach().to(means, non_blocking=means.is_cuda).contiguous()
        for matrix in projection[:2]
    )

    def one_pass(layers: Sequence[Layer]) -> Raster:
        channels = [layer.features.shape[1] for layer in layers]
        what = _Pass({_SLOTS[c]: c for c in channels}, *projection[2:])
        inputs = (*geometry, offset, *(tensor for layer in layers for tensor in layer))
        outputs = _FusedPass.apply(what, viewmat, K, *inputs)
        return Raster(
            tuple(Blend(*outputs[i : i + 3]) for i in range(0, 3 * len(channels), 3)), outputs[-1]
        )

    return in_passes(layers, one_pass)
