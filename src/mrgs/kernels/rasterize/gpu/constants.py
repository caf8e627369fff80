"""The constants of the image model and of the records, as Triton wants them; the records, and the
gradients of a (tile, Gaussian) pair, are those of the CPU kernels, explained in ``splat``."""

from __future__ import annotations

import math

import triton.language as tl

from mrgs.rasterizer import contract, splat

NEAR_PLANE = tl.constexpr(contract.NEAR_PLANE)
MARGIN = tl.constexpr(contract.FRUSTUM_MARGIN)
ALPHA_MAX = tl.constexpr(contract.ALPHA_MAX)
ALPHA_MIN = tl.constexpr(contract.ALPHA_MIN)
TRANSMITTANCE_MIN = tl.constexpr(contract.TRANSMITTANCE_MIN)

EXPONENT = tl.constexpr(-0.5 / math.log(2.0))
"""exp(−½ x) = 2 ** (EXPONENT · x)."""

LARGEST_PX = tl.constexpr(1e9)
"""Gaussians that reach farther are left out, with those whose place or size is not a number."""

TILE_WIDTH = tl.constexpr(16)
TILE_HEIGHT = tl.constexpr(8)
TILE_PIXELS = tl.constexpr(16 * 8)
"""One warp blends a tile, each thread four of its pixels: pixels left and sums are shared in the
warp without a barrier, and small images still give many tiles to many processors."""

SLACK_PX = tl.constexpr(1e-3)
"""Widens the ellipse against rounding: a tile too many costs time, one too few a pixel."""

MEAN_X = tl.constexpr(splat.MEAN_X)
MEAN_Y = tl.constexpr(splat.MEAN_Y)
ACROSS = tl.constexpr(splat.ACROSS)
SHEAR = tl.constexpr(splat.SHEAR)
ALONG = tl.constexpr(splat.ALONG)
EXTENT_Y = tl.constexpr(splat.EXTENT_Y)
HALF_WIDTH = tl.constexpr(splat.HALF_WIDTH)
DEPTH = tl.constexpr(splat.DEPTH)
COLOR = tl.constexpr(splat.COLOR)
SCALAR = tl.constexpr(splat.SCALAR)
SPLAT_FLOATS = tl.constexpr(splat.SPLAT_FLOATS)

GRAD_ACROSS = tl.constexpr(splat.GRAD_ACROSS)
GRAD_DY = tl.constexpr(splat.GRAD_DY)
GRAD_ACROSS_ACROSS = tl.constexpr(splat.GRAD_ACROSS_ACROSS)
GRAD_ACROSS_DY = tl.constexpr(splat.GRAD_ACROSS_DY)
GRAD_DY_DY = tl.constexpr(splat.GRAD_DY_DY)
GRAD_DEPTH = tl.constexpr(splat.GRAD_DEPTH)
GRAD_COLOR = tl.constexpr(splat.GRAD_COLOR)
GRAD_SCALAR = tl.constexpr(splat.GRAD_SCALAR)
GRAD_FLOATS = tl.constexpr(splat.GRAD_FLOATS)
