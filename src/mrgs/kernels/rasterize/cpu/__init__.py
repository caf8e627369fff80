"""The rasterizer for the CPU, in Numba: nothing is compiled at install time."""

from mrgs.kernels.rasterize.cpu.rasterize import median_depth, rasterize

__all__ = ["median_depth", "rasterize"]
