"""The rasterizer for NVIDIA GPUs, in Triton: nothing is compiled at install time.

Importing this package imports Triton; ``mrgs.system.gpu.serves`` says whether to.
"""

from mrgs.rasterizer.gpu.rasterize import rasterize

__all__ = ["rasterize"]
