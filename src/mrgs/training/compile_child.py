"""Half of a training's kernels, compiled in a process of its own: ``python -m
mrgs.training.compile_child REQUEST``, started by ``compilation``.

See ``mrgs.system.child`` for the protocol; the request holds ``config`` (YAML), and nothing is
reported. Compiled are those that the training itself needs last.
"""

from __future__ import annotations

import os
import warnings

import torch

from mrgs.errors import MrgsWarning
from mrgs.field import RadianceField
from mrgs.field.spherical_harmonics import MAX_DEGREE, shade
from mrgs.method.camera_model.image_model import Capture, ImageModel
from mrgs.method.config import TrainConfig, from_yaml
from mrgs.method.losses.term import LossContext, SceneScale
from mrgs.method.losses.terms import configured_terms, term_values
from mrgs.method.start.start_points import StartPoints, blended_apart, initial_gaussians
from mrgs.scene import BUILT_IN, RGB, Blend, Camera, Gaussians, Rendering, TemperatureRange
from mrgs.system.child import read_request, send, when_asked_to_stop
from mrgs.system.gpu import HOST
from mrgs.system.operation import checking
from mrgs.training.kernel_check import SAMPLED_GAUSSIANS, WIDTH_PX, random_photo


def compile_half(config: TrainConfig) -> None:
    """Compute on random numbers, with gradients, what the training would compile the kernels for
    last: the harmonics while it still reads its photos, and all that is not the rasterizer."""
    with checking():
        _compile_harmonics(config)
        if config.field.residuals:
            _compile_thermal_branch(config)
        _compile_losses(config)


def _compile_harmonics(config: TrainConfig) -> None:
    """Shade random Gaussians, with gradients, so that the kernels of the harmonics are compiled."""
    gaussians = _random_gaussians(config, torch.Generator().manual_seed(0))
    dc, rest = gaussians.sh_dc[RGB], gaussians.sh_rest[RGB]
    shade(gaussians.means, dc, rest, torch.zeros(3), MAX_DEGREE, torch.arange(len(gaussians)))


def _compile_losses(config: TrainConfig) -> None:
    """Compute the losses of random images, with gradients, so that their kernels are compiled."""
    generator = torch.Generator().manual_seed(0)
    camera = Camera(torch.eye(3), torch.eye(4), WIDTH_PX, WIDTH_PX)
    photos = {each: random_photo(camera, each.channels, generator, HOST) for each in BUILT_IN}
    ones = torch.ones(WIDTH_PX, WIDTH_PX)
    rendering = Rendering(
        {
            each: Blend(*(x.clone().requires_grad_() for x in (photo.values, ones, ones)))
            for each, photo in photos.items()
        }
    )
    capture = Capture((), 1.0, True)
    context = LossContext(
        rendering=rendering,
        observed=ImageModel(config.image_model, capture)(rendering, 0),
        photos=photos,
        cameras=dict.fromkeys(BUILT_IN, camera),
        gaussians=_random_gaussians(config, generator),
        dilation=config.dilation_of(capture),
        scale=SceneScale(1.0, TemperatureRange(0.0, 1.0), thermal_noise=0.1),
        render=lambda cameras: rendering,
    )
    term_values(configured_terms(config), context)


def _compile_thermal_branch(config: TrainConfig) -> None:
    """Compute the temperature residuals of random Gaussians, with gradients, so that their kernels
    are compiled."""
    field = RadianceField(config.field)
    gaussians = _random_gaussians(config, torch.Generator().manual_seed(0))
    field.set_frame(gaussians.means)
    neighbours = field.neighbours_of(gaussians.means)
    field.temperature_residuals(gaussians, neighbours, torch.arange(len(gaussians)), 0)


def _random_gaussians(config: TrainConfig, generator: torch.Generator) -> Gaussians:
    """As a training starts with them."""
    count = SAMPLED_GAUSSIANS
    values = {each: torch.rand(count, each.channels, generator=generator) for each in BUILT_IN}
    points = StartPoints(
        torch.randn(count, 3, generator=generator),
        values,
        {each: torch.full((count,), 0.5) for each in BUILT_IN},
        torch.full((count,), torch.inf),
    )
    apart = blended_apart(BUILT_IN, config.shares_opacity)
    gaussians = initial_gaussians(points, RadianceField(config.field), apart, 0)
    for tensor in gaussians.tensors().values():
        tensor.requires_grad_()
    return gaussians


def main() -> None:
    """Compile for the request."""
    when_asked_to_stop(lambda: os._exit(0))
    warnings.simplefilter("ignore", MrgsWarning)  # the training says the same
    compile_half(from_yaml(read_request()["config"], "the request"))
    send(end="compiled")


if __name__ == "__main__":
    main()
