"""The rasterizer for the CPU, in Numba: nothing is compiled at install time."""

from mrgs.kernels.rasterize.cpu.rasterize import rasterize

__all__ = ["rasterize"]
