"""A target that both cameras see, as observations for the calibration of the rig."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from mrgs.prepare.rig.adjust import Adjusted, Observations
from mrgs.prepare.rig.contract import ChessboardTarget, RigPair, TargetFit
from mrgs.prepare.rig.search import Guess
from mrgs.prepare.rig.target.localise import TargetGeometry, localise
from mrgs.prepare.rig.target.sightings import Sighting, find_sightings

CORNERS = 1
"""The kind of a target's corners among observations; patches are 0."""


@dataclass(frozen=True, eq=False)
class ObservedTarget:
    """A target that was detected and located.

    Attributes:
        geometry: its sightings and their corners in space.
        square_m: width of its squares in metres; None if not known.
    """

    geometry: TargetGeometry
    square_m: float | None

    def world_points(self, name: str) -> Float[np.ndarray, "k 3"]:
        """The corners that the photo of a pair sees, in the world; none if it does not see the
        target."""
        for sighting, points in self._located:
            if sighting.name == name:
                viewmat = sighting.camera.viewmat.numpy()
                return np.einsum("ji,nj->ni", viewmat[:3, :3], points - viewmat[:3, 3])
        return np.zeros((0, 3))

    @property
    def _located(self) -> Iterator[tuple[Sighting, Float[np.ndarray, "n 3"]]]:
        return zip(self.geometry.sightings, self.geometry.points, strict=True)

    def observations(self, names: Sequence[str]) -> Observations:
        """The corners in the thermal images, as observations of the adjustment.

        Args:
            names: of the pairs, in the order in which the cameras are counted.
        """
        views = [torch.zeros(0, dtype=torch.int64)]
        points = [torch.zeros(0, 3, dtype=torch.float64)]
        pixels = [torch.zeros(0, 2, dtype=torch.float64)]
        for sighting, corners in self._located:
            if sighting.thermal is not None and sighting.name in names:
                views.append(torch.full((len(corners),), list(names).index(sighting.name)))
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
        """The focal length, rotation and shift that map the corners of the photos best to those of
        the thermal images.
        """
        both = [
            (s.rays, s.thermal.pixels) for s in self.geometry.sightings if s.thermal is not None
        ]
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
        """Reprojection errors of the target's corners in the adjusted cameras, and its scale."""
        residuals = adjusted.residual_px[observations.kinds == CORNERS]
        if not len(residuals):
            residuals = torch.full((1,), torch.nan)
        stationary = self.geometry.stationary
        return TargetFit(
            pairs=sum(sighting.thermal is not None for sighting in self.geometry.sightings),
            stationary=stationary,
            residual_px=(float(residuals.quantile(0.5)), float(residuals.quantile(0.9))),
            metres_per_unit=self.square_m / self.geometry.square
            if self.square_m is not None and stationary
            else None,
        )


def observe_target(
    pairs: Sequence[RigPair],
    target: ChessboardTarget,
    metres_per_unit: float | None,
    report: Callable[[str, int, int], None],
) -> ObservedTarget:
    """Detect a target in all pairs and locate its corners.

    Args:
        metres_per_unit: of the scene; None if that is not known.
        report: called with a stage's name, and how many of its steps are done and there are.

    Raises:
        SceneError: no pair shows it in both images, or its distance is ambiguous.
    """
    sightings = find_sightings(pairs, target, report)
    square = None
    if target.square_m is not None and metres_per_unit is not None:
        square = target.square_m / metres_per_unit
    return ObservedTarget(localise(sightings, square), target.square_m)
