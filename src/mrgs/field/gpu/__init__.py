"""The field's Triton kernels; the plain torch and SciPy code of ``mrgs.field`` is the
definition."""

from mrgs.field.gpu.neighbours import MAX_K, nearest_neighbours

__all__ = ["MAX_K", "nearest_neighbours"]
