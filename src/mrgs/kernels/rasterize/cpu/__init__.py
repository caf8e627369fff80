"""The rasterizer for the CPU, in Numba: nothing is compiled at install time."""
