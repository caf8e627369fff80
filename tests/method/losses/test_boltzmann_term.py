"""L_boltz as a training sees it: what moves what."""

from __future__ import annotations

import torch
from torch import Tensor

from mrgs.method.losses.radiation import RadiationConfig
from mrgs.method.losses.term import LossContext, SceneScale
from mrgs.method.losses.terms import Boltzmann
from mrgs.rasterizer.contract import Dilation
from mrgs.scene import THERMAL, Blend, Camera, Pixels, Rendering, TemperatureRange
from tests.helpers.gaussians import random_gaussians
from tests.helpers.views import not_rendered

CELSIUS = TemperatureRange(10.0, 60.0)


def confident() -> Boltzmann:
    """L_boltz whose uncertainty is the same everywhere."""
    term = Boltzmann(RadiationConfig(), 1e-3)
    assert term.learned is not None
    for parameter in term.learned.parameters():
        parameter.data.zero_()
    return term


def small_context(
    photo: Tensor, temperature: TemperatureRange | None, alpha: Tensor
) -> tuple[LossContext, Tensor, Tensor]:
    """A view of this thermal photo, with the rendered temperatures and depths."""
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(20, 24, 1, generator=generator).requires_grad_()
    depth = (1 + torch.rand(20, 24, generator=generator)).requires_grad_()
    rendering = Rendering({THERMAL: Blend(image, depth, alpha)})
    context = LossContext(
        rendering=rendering,
        observed=rendering,
        photos={THERMAL: Pixels(photo)},
        cameras={THERMAL: Camera(torch.eye(3), torch.eye(4), 24, 20)},
        gaussians=random_gaussians(3),
        dilation=Dilation(),
        scale=SceneScale(3.0, temperature),
        render=not_rendered,
    )
    return context, image, depth


def test_the_uncertainty_does_not_move_the_depth() -> None:
    """Where nothing radiates, only u could move D_t."""
    context, _, depth = small_context(torch.zeros(20, 24, 1), None, torch.ones(20, 24))
    value = Boltzmann(RadiationConfig(), 1e-3).value(context)
    assert value is not None
    (gradient,) = torch.autograd.grad(value, depth)
    assert (gradient == 0).all()


def test_pixels_that_show_no_surface_do_not_count() -> None:
    alpha = torch.ones(20, 24)
    alpha[:8] = 0.4
    photo = torch.rand(20, 24, 1, generator=torch.Generator().manual_seed(1))
    context, image, depth = small_context(photo, CELSIUS, alpha)
    value = confident().value(context)
    assert value is not None
    for gradient in torch.autograd.grad(value, (image, depth)):
        assert (gradient[:8] == 0).all()
        assert (gradient[8:] != 0).any()
