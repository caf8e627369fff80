"""Alpha blending of projected Gaussians: the contract, and its plain definition."""

from __future__ import annotations

from mrgs.rasterizer import reference
from mrgs.rasterizer.contract import Geometry, Layer, Projection, Raster
from mrgs.scene import Blend
from mrgs.system.operation import operation

__all__ = ["Blend", "Geometry", "Layer", "Projection", "Raster", "median_depth", "rasterize"]

rasterize = operation(reference.rasterize)
"""``reference.rasterize``: by a kernel for float32 on the CPU or a GPU."""

median_depth = operation(measure=reference.depth_quantiles)(reference.median_depth)
"""``reference.median_depth``: of the surface that a layer shows; by a kernel for float32."""
