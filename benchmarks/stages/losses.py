"""The losses of a step, each forward and backward to the rendered images."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.plan import Case
from benchmarks.timing import Stages, Timing
from benchmarks.workload import EXTENT, TEMPERATURE, photos
from mrgs.method.losses.photometric import LossConfig, photometric_loss
from mrgs.method.losses.radiation import (
    DepthUncertainty,
    boltzmann_loss,
    normalise_radiation,
    thermal_radiation,
)
from mrgs.method.losses.smoothness import smoothness_loss

PHOTOMETRIC = "L1 + D-SSIM, 4 channels"


def stages(case: Case) -> Stages:
    """Photometric, smoothness and radiation loss."""
    assert case.width is not None
    assert case.height is not None
    losses = Losses(case.width, case.height)
    return Stages(
        [
            Timing(PHOTOMETRIC, lambda _: losses.photometric()),
            Timing("smoothness, 4 channels and 2 depths", lambda _: losses.smoothness()),
            Timing("radiation", lambda _: losses.radiation()),
        ]
    )


class Losses:
    """Images of noise as rendered, photos of noise as targets; each method returns the
    gradients."""

    def __init__(self, width: int, height: int) -> None:
        self._config = LossConfig()
        self._uncertainty = DepthUncertainty()
        self._targets = [pixels.values for pixels in photos(width, height).values()]
        generator = torch.Generator().manual_seed(4)
        self._images = [
            torch.rand(t.shape, generator=generator).requires_grad_() for t in self._targets
        ]
        depths = [2 + 4 * torch.rand(height, width, generator=generator) for _ in self._targets]
        self._depths = [depth.requires_grad_() for depth in depths]

    def photometric(self) -> tuple[Tensor, ...]:
        """L_m of both modalities."""
        terms = [
            photometric_loss(image, target, None, self._config.dssim)
            for image, target in zip(self._images, self._targets, strict=True)
        ]
        return torch.autograd.grad(torch.stack(terms).sum(), self._images)

    def smoothness(self) -> tuple[Tensor, ...]:
        """L_smooth of both modalities."""
        terms = [
            smoothness_loss(image, depth, None, EXTENT, 1.0, self._config)
            for image, depth in zip(self._images, self._depths, strict=True)
        ]
        return torch.autograd.grad(torch.stack(terms).sum(), [*self._images, *self._depths])

    def radiation(self) -> tuple[Tensor, ...]:
        """L_boltz."""
        depth, image = self._depths[1], self._images[1]
        radiation = normalise_radiation(
            thermal_radiation(self._targets[1][..., 0], depth, EXTENT, TEMPERATURE)
        )
        loss = boltzmann_loss(image[..., 0], radiation, self._uncertainty(depth, EXTENT))
        return torch.autograd.grad(loss, [image, depth, *self._uncertainty.parameters()])
