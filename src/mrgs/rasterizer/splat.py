"""The record of a projected Gaussian: sixteen floats, one cache line, read by all kernels."""

from __future__ import annotations

MEAN_X = 0
MEAN_Y = 1
"""Projected centre μ' in pixels."""

ACROSS = 2
SHEAR = 3
ALONG = 4
"""log2 of the Gaussian is ACROSS·(dx − SHEAR·dy)² + ALONG·dy², a sum of two terms that are never
positive.

SHEAR is the dx of the ellipse's midline per dy. Written out as a quadratic form of dx and dy, the
terms of a thin slanting Gaussian would cancel in float32.
"""

THRESHOLD = 5
"""log2 of the Gaussian at which α reaches 1/255 in the more opaque layer."""

EXTENT_Y = 6
"""Half the height in pixels of the ellipse α >= 1/255."""

HALF_WIDTH = 7
"""Half the width of the ellipse along the line dy = 0, in pixels."""

DEPTH = 8
DISTANCE = 9
"""z-depth, and the distance from the camera's centre, by which a CPU sorts."""

COLOR = 10
SCALAR = 14
"""Each layer's part of the record: its opacity, then its features."""

SPLAT_FLOATS = 16

# Gradients with respect to the record, summed over the pixels of one tile. With v = α ∂L/∂α of both
# layers together, across = dx − SHEAR·dy and dy, the gradients of μ' and Σ' follow from the moments
# Σ v·across, Σ v·dy, Σ v·across², Σ v·across·dy and Σ v·dy².
GRAD_ACROSS = 0
GRAD_DY = 1
GRAD_ACROSS_ACROSS = 2
GRAD_ACROSS_DY = 3
GRAD_DY_DY = 4
GRAD_DEPTH = 5

GRAD_COLOR = 6
GRAD_SCALAR = 10
"""Each layer's part: Σ α ∂L/∂α of that layer alone, then the gradients of its features."""

GRAD_LAYERS = (GRAD_COLOR, GRAD_SCALAR)
GRAD_FLOATS = 12
