"""Fast implementations of the method's operations, one folder per operation.

``TABLE`` names the plain definition that each kernel replaces. It consists of names, so that Numba
and Triton are imported when the first kernel that needs them is called. Kernels import the plain
definitions' constants and types; the method does not import kernels: ``mrgs.system.operation``
finds this table by its name. Methods of other packages add kernels of their own by
``mrgs.system.operation.register_kernels``.
"""

from __future__ import annotations

import torch

from mrgs.system.operation import Kernel

_ANY_FLOAT = (torch.float32, torch.float64)

_COLOR_HEAD = "mrgs.field.appearance.color_residuals"
_HEAT = "mrgs.field.field.RadianceField.temperature_residuals"
_SHADE = "mrgs.field.spherical_harmonics.shade"
_NEIGHBOURS = "mrgs.field.heat.nearest_neighbours"
_ADAM = "mrgs.method.adam.move"
_RASTERIZE = "mrgs.rasterizer.reference.rasterize"
_MEDIAN_DEPTH = "mrgs.rasterizer.reference.median_depth"
_BLUR = "mrgs.method.camera_model.point_spread.blur"
_PHOTOMETRIC = "mrgs.method.losses.photometric.photometric_loss"
_BOLTZMANN = "mrgs.method.losses.radiation.boltzmann_loss"
_CONVOLVE = "mrgs.method.losses.radiation.convolve"
_VARIATION = "mrgs.method.losses.smoothness.total_variation"

TABLE = (
    Kernel(_ADAM, "mrgs.kernels.adam.move", "cpu", _ANY_FLOAT),
    Kernel(_ADAM, "mrgs.kernels.adam.gpu.move", "gpu"),
    Kernel(_COLOR_HEAD, "mrgs.kernels.color_head.color_residuals", "cpu"),
    Kernel(_HEAT, "mrgs.kernels.heat.residuals.residuals_on_cpu", "cpu"),
    Kernel(_HEAT, "mrgs.kernels.heat.residuals.residuals_on_gpu", "gpu"),
    Kernel(_SHADE, "mrgs.kernels.harmonics.cpu.shade", "cpu"),
    Kernel(_SHADE, "mrgs.kernels.harmonics.gpu.shade", "gpu"),
    Kernel(_NEIGHBOURS, "mrgs.kernels.neighbours.nearest_neighbours", "cpu", _ANY_FLOAT),
    Kernel(_NEIGHBOURS, "mrgs.kernels.neighbours.gpu.nearest_neighbours", "gpu"),
    Kernel(_RASTERIZE, "mrgs.kernels.rasterize.cpu.rasterize.rasterize", "cpu"),
    Kernel(_RASTERIZE, "mrgs.kernels.rasterize.gpu.rasterize.rasterize", "gpu"),
    Kernel(_MEDIAN_DEPTH, "mrgs.kernels.rasterize.cpu.rasterize.median_depth", "cpu"),
    Kernel(_MEDIAN_DEPTH, "mrgs.kernels.rasterize.gpu.rasterize.median_depth", "gpu"),
    Kernel(_BLUR, "mrgs.kernels.blur.cpu.blur", "cpu", _ANY_FLOAT),
    Kernel(_BLUR, "mrgs.kernels.blur.gpu.blur", "gpu"),
    Kernel(_PHOTOMETRIC, "mrgs.kernels.ssim.cpu.photometric_loss", "cpu", _ANY_FLOAT),
    Kernel(_PHOTOMETRIC, "mrgs.kernels.ssim.gpu.photometric_loss", "gpu"),
    Kernel(_BOLTZMANN, "mrgs.kernels.ssim.cpu.boltzmann_loss", "cpu", _ANY_FLOAT),
    Kernel(_BOLTZMANN, "mrgs.kernels.ssim.gpu.boltzmann_loss", "gpu"),
    Kernel(_CONVOLVE, "mrgs.kernels.convolution.convolve", "cpu", _ANY_FLOAT),
    Kernel(_CONVOLVE, "mrgs.kernels.convolution.convolve_on_gpu", "gpu"),
    Kernel(_VARIATION, "mrgs.kernels.variation.total_variation", "cpu", _ANY_FLOAT),
    Kernel(_VARIATION, "mrgs.kernels.variation.total_variation", "gpu"),
)
"""The kernels of the method, and the operations that they compute."""
