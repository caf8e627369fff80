"""The record of a projected Gaussian: sixteen floats, one cache line, read by the tiler and the blender."""

from __future__ import annotations

MEAN_X = 0
MEAN_Y = 1
"""Projected centre μ' in pixels."""

CONIC_XX = 2
CONIC_XY = 3
CONIC_YY = 4
"""log2 of the Gaussian is CONIC_XX·dx² + CONIC_XY·dx·dy + CONIC_YY·dy²: Σ'⁻¹ times −log2(e)/2, cross terms added."""

THRESHOLD = 5
"""log2 of the Gaussian at which α reaches 1/255 in the more opaque layer."""

OPACITY_RGB = 6
OPACITY_THERMAL = 7
DEPTH = 8
RED = 9
GREEN = 10
BLUE = 11
TEMPERATURE = 12

EXTENT_Y = 13
"""Half the height in pixels of the ellipse α >= 1/255."""

SHEAR = 14
"""dx of the ellipse's midline per dy."""

HALF_WIDTH = 15
"""Half the width of the ellipse along the line dy = 0, in pixels."""

SPLAT_FLOATS = 16

# Gradients with respect to the record, summed over the pixels of one tile, dx and dy being pixel centre − μ' and
# v = α ∂L/∂α of both layers together: everything else follows from these moments.
GRAD_ALPHA_RGB = 0
GRAD_ALPHA_THERMAL = 1
GRAD_DX = 2
GRAD_DY = 3
GRAD_DXDX = 4
GRAD_DXDY = 5
GRAD_DYDY = 6
GRAD_RED = 7
GRAD_GREEN = 8
GRAD_BLUE = 9
GRAD_TEMPERATURE = 10
GRAD_DEPTH = 11
GRAD_FLOATS = 12
