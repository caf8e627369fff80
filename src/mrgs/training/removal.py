"""What leaving out a Gaussian would change in the photos."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.method.config import TrainConfig
from mrgs.method.losses.term import SceneScale
from mrgs.scene import Pixels
from mrgs.training.state import TrainingState
from mrgs.training.view_pass import (
    PhotographedView,
    coarser,
    pixel_sizes,
    rendered,
    view_inputs,
)

MOST_VIEWS = 64
"""Views that are looked at, spread over all."""

PIXEL_SIZE = 4
"""Photos are reduced by this factor, if they are large enough (``coarser``)."""

LEAST = 1e-6
"""Neither a photo's squared error nor a transparency counts as smaller."""


def removal_errors(
    state: TrainingState,
    views: Iterable[PhotographedView],
    config: TrainConfig,
    scale: SceneScale,
) -> Float[Tensor, " n"]:
    """By how much leaving each Gaussian out would raise the squared errors of views' photos, as a
    share of these errors, summed over views and modalities: an unbiased estimate, [N].

    A pixel is linear in each opacity o_i: without Gaussian i it changes by −o_i ∂C/∂o_i, to the
    colour behind. The sum of the squares of these changes over all pixels is the expectation of
    (Σ s o_i ∂C/∂o_i)² for random signs s (Hutchinson), so one backward pass by view gives it for
    all Gaussians. Errors of neighbouring views are alike, and their mean is what is asked for.
    """
    gaussians = state.model.gaussians
    total = torch.zeros(len(gaussians), device=state.device)
    state.model.neighbours = None  # rows may have changed since they were searched
    state.refresh_neighbours(config)
    for each in views:
        cameras, photos = coarser(each.view.cameras, each.photos, PIXEL_SIZE)
        inputs = view_inputs(state, each, config)._replace(
            cameras=cameras, photos=photos, pixel_sizes=pixel_sizes(each.view.cameras, cameras)
        )
        context, _ = rendered(state.model, state.image_model, inputs, scale)
        signed = [
            _signed(
                blend.image, context.observed[modality].image, photos[modality], state.generator
            )
            for modality, blend in context.rendering.items()
            if modality in photos
        ]
        torch.stack(signed).sum().backward()
        found = [
            logits.grad[:, 0] / torch.sigmoid(-logits.detach()[:, 0]).clamp_min(LEAST)
            for logits in gaussians.opacity_logits.values()
            if logits.grad is not None
        ]
        total += torch.stack(found).sum(dim=0).square()
        state.gaussian_optimizer.zero_grad()
        state.layer_optimizer.zero_grad()
    return total


def _signed(
    image: Float[Tensor, "h w c"],
    observed: Float[Tensor, "h w c"],
    photo: Pixels,
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """The valid pixels with random signs, over the root of what they differ from the photo by."""
    # Drawn on the host, so that they do not depend on the device.
    signs = (2 * torch.randint(2, image.shape, generator=generator) - 1).to(image)
    errors = (observed.detach() - photo.values).square()
    if photo.valid is not None:
        signs, errors = (each * photo.valid[:, :, None] for each in (signs, errors))
    return (signs * image).sum() / errors.sum().clamp_min(LEAST).sqrt()
