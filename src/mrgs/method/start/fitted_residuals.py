"""Temperature residuals that start with what the photos say (not in the paper).

Left to themselves t_i and t̂ share one task, and whichever learns faster leaves the other nothing:
with temperatures read off the photos t̂ stays 0, and no equation of the thermal branch matters. So
the layers are fitted to these temperatures first, and t_i starts as what they cannot say.
"""

from __future__ import annotations

import torch

from mrgs.field import RadianceField, nearest_neighbours
from mrgs.field.spherical_harmonics import C0
from mrgs.method.start.start_points import UNSEEN
from mrgs.scene import THERMAL, Gaussians

ROWS = 2_000
"""Gaussians that a step of the fit looks at."""

RATE = 5e-3


def fit_residuals(
    field: RadianceField, gaussians: Gaussians, steps: int, generator: torch.Generator
) -> None:
    """Fit t̂ to the Gaussians' temperatures, and leave in t_i what remains.

    Args:
        field: changed in place; without residuals nothing is done.
        gaussians: their temperature coefficients of degree 0 are changed in place. One that no
            photo shows (at 0.5) does not count, and gets t_i = 0: its neighbours speak for it.
        steps: of Adam.
        generator: of the Gaussians that a step looks at.
    """
    if not field.config.residuals or steps == 0:
        return
    k = field.config.neighbours_k
    neighbours = nearest_neighbours(gaussians.means, k) if k > 0 else None
    target = C0 * gaussians.sh_dc[THERMAL][:, 0]
    seen = (target[:, 0] != UNSEEN - 0.5).nonzero()[:, 0]
    if len(seen) == 0:
        return
    with torch.no_grad():
        field.temperature_output.bias.fill_(target[seen].mean() / field.config.temperature_scale)
    adam = torch.optim.Adam(field.parameters(), lr=RATE)
    for step in range(steps):
        adam.param_groups[0]["lr"] = RATE * (1 - step / steps)
        chosen = seen[torch.randperm(len(seen), generator=generator)[:ROWS]]
        residuals = field.temperature_residuals(gaussians, neighbours, chosen, 0)
        (residuals - target[chosen]).abs().mean().backward()
        adam.step()
        adam.zero_grad()
    with torch.no_grad():
        residuals = field.temperature_residuals(gaussians, neighbours, None, 0)
        own = torch.zeros_like(target)
        own[seen] = target[seen] - residuals[seen]
        gaussians.sh_dc[THERMAL].copy_((own / C0)[:, None])
