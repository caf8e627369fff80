"""The losses' Triton kernels for float32 tensors on a GPU; plain torch beside them is the
definition.

Values stay on the device: nothing here makes the host wait.
"""

from mrgs.method.gpu.dissimilarity import compare
from mrgs.method.gpu.point_spread import spread_points
from mrgs.method.gpu.variation import total_variation

__all__ = ["compare", "spread_points", "total_variation"]
