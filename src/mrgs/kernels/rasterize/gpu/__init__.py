"""The rasterizer for NVIDIA GPUs, in Triton: nothing is compiled at install time.

Importing this package imports Triton; ``mrgs.system.gpu.runs_triton`` says whether to.
"""

from mrgs.kernels.rasterize.gpu.rasterize import rasterize

__all__ = ["rasterize"]
