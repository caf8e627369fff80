"""Temperature residuals that start with what the photos show (not in the paper). Of t_i and t̂,
which share one task, the faster learner leaves the other nothing: with temperatures read off the
photos t̂ would stay 0. So the layers are fitted to these first, and t_i starts as the rest."""

from __future__ import annotations

import warnings

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from mrgs.errors import KernelWarning
from mrgs.field import RadianceField
from mrgs.field.spherical_harmonics import C0
from mrgs.method.adam import Adam, ParameterGroup
from mrgs.scene import THERMAL, Gaussians
from mrgs.system.operation import checking

ROWS = 2_000
"""Number of Gaussians in a step of the fit."""

RATE = 5e-3


def fit_residuals(
    field: RadianceField,
    gaussians: Gaussians,
    temperatures: Float[Tensor, "n 1"],
    steps: int,
    generator: torch.Generator,
) -> None:
    """Fit t̂ of a field with residuals to the Gaussians' normalised temperatures by steps of Adam,
    and leave in t_i what remains, both in place. A Gaussian whose temperature no photo shows, NaN,
    does not count, and gets t_i = 0: its neighbours speak for it."""
    target = temperatures - 0.5
    known = target[:, 0].isfinite().nonzero()[:, 0]
    if not field.config.residuals or steps == 0 or len(known) == 0:
        return
    neighbours = field.neighbours_of(gaussians.means)
    with torch.no_grad():
        field.temperature_output.bias.fill_(target[known].mean() / field.config.temperature_scale)
    _check_kernel(field, gaussians.rows(known[:ROWS]))
    layers = ParameterGroup(list(field.parameters()), RATE)
    adam = Adam([layers])
    for step in range(steps):
        layers.rate = RATE * (1 - step / steps)
        chosen = known[torch.randperm(len(known), generator=generator)[:ROWS]]
        found = field.temperature_residuals(gaussians, neighbours, chosen, 0)
        (found - target[chosen]).abs().mean().backward()
        adam.step()
        adam.zero_grad()
    leave_the_rest(field, gaussians, temperatures, neighbours)


@torch.no_grad()
def leave_the_rest(
    field: RadianceField,
    gaussians: Gaussians,
    temperatures: Float[Tensor, "n 1"],
    neighbours: Int64[Tensor, "n k"] | None,
) -> None:
    """Set t_i to what t̂ of a field with residuals lacks to the Gaussians' temperatures; see
    ``fit_residuals``. The neighbours are from ``field.neighbours_of``."""
    if not field.config.residuals:
        return
    residuals = field.temperature_residuals(gaussians, neighbours, None, 0)
    own = (temperatures - 0.5 - residuals).nan_to_num(nan=0.0)
    gaussians.sh_dc[THERMAL].copy_((own / C0)[:, None])


def _check_kernel(field: RadianceField, sample: Gaussians) -> None:
    """Compare the kernel with the plain definition, on few Gaussians, which saves memory."""
    neighbours = field.neighbours_of(sample.means)
    with checking(), warnings.catch_warnings():
        warnings.simplefilter("ignore", KernelWarning)  # the training's own check names the kernel
        field.temperature_residuals(sample, neighbours, torch.arange(len(sample)), 0)
