"""The Gaussians that training starts from."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.field import RadianceField, nearest_neighbours
from mrgs.field.spherical_harmonics import C0, MAX_DEGREE
from mrgs.method.start.start_points import StartPoints
from mrgs.scene import THERMAL, Gaussians, Modality

INITIAL_SCALE_NEIGHBOURS = 3
UNSEEN = 0.5
"""Colour and temperature of a point of which no photo tells them."""

SMALLEST_DISTANCE = 1e-7
"""Coincident points still become Gaussians of some size (scene units)."""


def initial_gaussians(
    points: StartPoints,
    field: RadianceField,
    apart: Sequence[Modality],
    temperature_sh_degree: int,
) -> Gaussians:
    """One isotropic Gaussian per start point, as large as the RMS distance to its three nearest
    points (3DGS).

    No larger than ``max_scales``, though: a distant point may have the scene's own points as
    neighbours.

    Args:
        points: start points.
        field: gives e_m its start; its frame must be set.
        apart: modalities with an opacity of their own; see ``blended_apart``.
        temperature_sh_degree: degree of the temperature's spherical harmonics, 0 to 3.
    """
    count = len(points.positions)
    values = {each: known.nan_to_num(nan=UNSEEN) for each, known in points.values.items()}
    means = points.positions.clone()
    degrees = dict.fromkeys(points.values, MAX_DEGREE) | {THERMAL: temperature_sh_degree}
    return Gaussians(
        means=means,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.minimum(_spacing(means), points.max_scales).log()[:, None].repeat(1, 3),
        opacity_logits={each: points.opacities[each].logit()[:, None] for each in apart},
        sh_dc={each: ((value - 0.5) / C0)[:, None] for each, value in values.items()},
        sh_rest={
            each: torch.zeros(count, (degrees[each] + 1) ** 2 - 1, each.channels)
            for each in points.values
        },
        embedding=field.initial_embedding(means),
    )


def _spacing(means: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Root mean square distance to the nearest points."""
    neighbours = nearest_neighbours(means, INITIAL_SCALE_NEIGHBOURS)
    squared = (means[neighbours] - means[:, None]).square().sum(dim=2).mean(dim=1)
    return squared.sqrt().clamp_min(SMALLEST_DISTANCE)
