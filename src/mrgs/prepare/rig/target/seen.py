"""What a target that both cameras see tells the calibration of the rig."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from mrgs.prepare.rig.adjust import Adjusted, Observations
from mrgs.prepare.rig.contract import ChessboardTarget, RigPair, TargetFit
from mrgs.prepare.rig.search import Guess
from mrgs.prepare.rig.target.place import Placed, place
from mrgs.prepare.rig.target.sightings import find_sightings

CORNERS = 1
"""The kind of a target's corners among observations; patches are 0."""


@dataclass(frozen=True, eq=False)
class SeenTarget:
    """A target that was found and placed.

    Attributes:
        placed: the sightings.
        names: of the pair of each sighting.
        square_m: width of its squares in metres, if known.
    """

    placed: Placed
    names: tuple[str, ...]
    square_m: float | None

    def world_points(self, name: str) -> Float[np.ndarray, "k 3"]:
        """The corners that the photo of a pair sees, in the world; none if it does not see the
        target."""
        if name not in self.names:
            return np.zeros((0, 3))
        index = self.names.index(name)
        viewmat = self.placed.sightings[index].camera.viewmat.numpy()
        return np.einsum("ji,nj->ni", viewmat[:3, :3], self.placed.points[index] - viewmat[:3, 3])

    def observations(self, names: Sequence[str]) -> Observations:
        """The corners in the thermal images.

        Args:
            names: of the pairs, in the order in which the cameras are counted.
        """
        views = [torch.zeros(0, dtype=torch.int64)]
        points = [torch.zeros(0, 3, dtype=torch.float64)]
        pixels = [torch.zeros(0, 2, dtype=torch.float64)]
        for name, sighting, corners in zip(
            self.names, self.placed.sightings, self.placed.points, strict=True
        ):
            if sighting.thermal is not None and name in names:
                views.append(torch.full((len(corners),), list(names).index(name)))
                points.append(torch.from_numpy(corners))
                pixels.append(torch.from_numpy(sighting.thermal.pixels.astype(np.float64)))
        count = sum(len(part) for part in views)
        return Observations(
            views=torch.cat(views),
            points=torch.cat(points),
            pixels=torch.cat(pixels),
            information=torch.eye(2, dtype=torch.float64).repeat(count, 1, 1),
            independent=torch.ones(count, dtype=torch.float64),
            kinds=torch.full((count,), CORNERS),
        )

    def guess(self, width: int, height: int) -> Guess:
        """The focal length, turn and shift that carry the corners best from the photos to the
        thermal images.

        Args:
            width: of the thermal images.
            height: of them.
        """
        both = [(s.rays, s.thermal.pixels) for s in self.placed.sightings if s.thermal is not None]
        rays, pixels = (
            np.einsum("nj,j->n", np.concatenate(parts), (1, 1j))
            for parts in zip(*both, strict=True)
        )
        ray, pixel = rays - rays.mean(), pixels - pixels.mean()
        product = complex((ray.conj() * pixel).sum())
        slope = product / float((abs(ray) ** 2).sum())
        middle = complex(pixels.mean() - slope * rays.mean())
        return Guess(
            score=abs(product) / float(np.sqrt((abs(ray) ** 2).sum() * (abs(pixel) ** 2).sum())),
            focal_widths=abs(slope) / width,
            turn_deg=-float(np.degrees(np.angle(slope))),
            shift_widths=(middle.real / width - 0.5, (middle.imag - height / 2) / width),
        )

    def fit(self, adjusted: Adjusted, observations: Observations) -> TargetFit:
        """How the adjusted cameras fit the target."""
        residuals = adjusted.residual_px[observations.kinds == CORNERS]
        if not len(residuals):
            residuals = torch.full((1,), torch.nan)
        still = self.placed.still
        return TargetFit(
            pairs=sum(sighting.thermal is not None for sighting in self.placed.sightings),
            still=still,
            residual_px=(float(residuals.quantile(0.5)), float(residuals.quantile(0.9))),
            metres_per_unit=self.square_m / self.placed.square
            if self.square_m is not None and still
            else None,
        )


def see_target(
    pairs: Sequence[RigPair],
    target: ChessboardTarget,
    metres_per_unit: float | None,
    report: Callable[[str, int, int], None],
) -> SeenTarget:
    """Find a target in all pairs and place it before their cameras.

    Args:
        pairs: photos and thermal images.
        target: what to look for.
        metres_per_unit: of the scene; None if that is not known.
        report: called with a stage's name, and how many of its steps are done and there are.

    Raises:
        SceneError: no pair shows it in both images, or its distance is ambiguous.
    """
    sightings = find_sightings(pairs, target, report)
    square = None
    if target.square_m is not None and metres_per_unit is not None:
        square = target.square_m / metres_per_unit
    placed = place(sightings, square)
    return SeenTarget(
        placed, tuple(pairs[sighting.pair].name for sighting in placed.sightings), target.square_m
    )
