"""The rasterizer for NVIDIA GPUs, in Triton: nothing is compiled at install time.

Importing this package imports Triton; ``mrgs.system.gpu.runs_triton`` decides whether to.
"""

from mrgs.kernels.rasterize.gpu.rasterize import median_depth, rasterize

__all__ = ["median_depth", "rasterize"]
