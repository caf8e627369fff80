"""Kernels: what makes the method fast. One folder per operation, with ``cpu`` and ``gpu`` in each.

``TABLE`` says which plain definition each of them replaces. It holds names only, so that Numba
and Triton are imported when the first kernel that needs them is called. Kernels import the plain
definitions' constants and types; no other part of the package imports kernels. The one way back is
``mrgs.system.operation``, which finds this table by its name.
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
_HASH_GRID = "mrgs.baselines.thermonerf.hash_grid.encode"
_PERCEPTRON = "mrgs.baselines.thermonerf.perceptron.perceptron"

TABLE = (
    Kernel(_ADAM, "mrgs.kernels.adam.gpu.move", "gpu"),
    Kernel(_COLOR_HEAD, "mrgs.kernels.color_head.cpu.color_residuals", "cpu"),
    Kernel(_HEAT, "mrgs.kernels.heat.cpu.temperature_residuals", "cpu"),
    Kernel(_HEAT, "mrgs.kernels.heat.gpu.temperature_residuals", "gpu"),
    Kernel(_SHADE, "mrgs.kernels.harmonics.cpu.shade", "cpu"),
    Kernel(_SHADE, "mrgs.kernels.harmonics.gpu.shade", "gpu"),
    Kernel(_NEIGHBOURS, "mrgs.kernels.neighbours.cpu.nearest_neighbours", "cpu", _ANY_FLOAT),
    Kernel(_NEIGHBOURS, "mrgs.kernels.neighbours.gpu.nearest_neighbours", "gpu"),
    Kernel(_RASTERIZE, "mrgs.kernels.rasterize.cpu.rasterize", "cpu"),
    Kernel(_RASTERIZE, "mrgs.kernels.rasterize.gpu.rasterize", "gpu"),
    Kernel(_MEDIAN_DEPTH, "mrgs.kernels.rasterize.cpu.median_depth", "cpu"),
    Kernel(_MEDIAN_DEPTH, "mrgs.kernels.rasterize.gpu.median_depth", "gpu"),
    Kernel(_BLUR, "mrgs.kernels.blur.cpu.blur", "cpu", _ANY_FLOAT),
    Kernel(_BLUR, "mrgs.kernels.blur.gpu.blur", "gpu"),
    Kernel(_PHOTOMETRIC, "mrgs.kernels.ssim.cpu.photometric_loss", "cpu", _ANY_FLOAT),
    Kernel(_PHOTOMETRIC, "mrgs.kernels.ssim.gpu.photometric_loss", "gpu"),
    Kernel(_BOLTZMANN, "mrgs.kernels.ssim.cpu.boltzmann_loss", "cpu", _ANY_FLOAT),
    Kernel(_BOLTZMANN, "mrgs.kernels.ssim.gpu.boltzmann_loss", "gpu"),
    Kernel(_CONVOLVE, "mrgs.kernels.convolution.cpu.convolve", "cpu", _ANY_FLOAT),
    Kernel(_CONVOLVE, "mrgs.kernels.convolution.gpu.convolve", "gpu"),
    Kernel(_VARIATION, "mrgs.kernels.variation.cpu.total_variation", "cpu", _ANY_FLOAT),
    Kernel(_VARIATION, "mrgs.kernels.variation.gpu.total_variation", "gpu"),
    Kernel(_HASH_GRID, "mrgs.kernels.hash_grid.cpu.encode", "cpu", _ANY_FLOAT),
    Kernel(_PERCEPTRON, "mrgs.kernels.perceptron.cpu.perceptron", "cpu"),
)
"""Every kernel, and the operation that it computes."""
