"""Gaussians without meaning, and a third modality."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from mrgs.scene import RGB, THERMAL, Gaussians, Modality

NEAR_INFRARED = Modality("nir", 1, title="near infrared")


def random_gaussians(
    count: int,
    shares_opacity: bool = False,
    bands: int = 0,
    seed: int = 0,
    embedding_width: int = 0,
    modalities: Sequence[Modality] = (RGB, THERMAL),
) -> Gaussians:
    """Normally distributed parameters.

    Args:
        count: number of Gaussians.
        shares_opacity: whether the first modality alone has an opacity.
        bands: columns of the thermal ``sh_rest``; 15 of all others.
        seed: of the numbers.
        embedding_width: of e_m.
        modalities: what they have an appearance of.
    """
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(count, *shape, generator=generator)

    return Gaussians(
        means=random(3),
        quats=random(4),
        log_scales=random(3),
        opacity_logits={each: random(1) for each in modalities[: 1 if shares_opacity else None]},
        sh_dc={each: random(1, each.channels) for each in modalities},
        sh_rest={
            each: random(bands if each == THERMAL else 15, each.channels) for each in modalities
        },
        embedding=random(embedding_width),
    )
