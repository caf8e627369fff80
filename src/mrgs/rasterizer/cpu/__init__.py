"""The rasterizer for the CPU, in Numba: nothing is compiled at install time."""

from mrgs.rasterizer.cpu.rasterize import rasterize

__all__ = ["rasterize"]
