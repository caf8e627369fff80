"""Pictures of large models while the camera moves: drawn from fewer Gaussians, as many as time
allows."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.render import Model, rows_in_view
from mrgs.scene import Camera
from mrgs.scene.level_of_detail import merged

MOST_IN_VIEW = 80_000
"""Gaussians that are drawn ten times a second by two cores."""

LEVEL_FACTOR = 5
"""A level has so many times the Gaussians of the one below it."""


class DetailLevel(NamedTuple):
    """A model of fewer Gaussians.

    Attributes:
        model: of this level.
        stands_for: how many of this level each Gaussian of the coarsest stands for.
    """

    model: Model
    stands_for: Float[Tensor, " m"]


class LevelsOfDetail:
    """A model in several levels of detail. They are made in a thread; until then there is only the
    model itself.

    Args:
        model: that no longer changes, in the host's memory.
        most_in_view: Gaussians that may be in view.
    """

    def __init__(self, model: Model, most_in_view: int = MOST_IN_VIEW) -> None:
        self._model = model
        self._most = most_in_view
        self._levels: Sequence[DetailLevel] = ()
        self.maker = threading.Thread(target=self._make, name="mrgs-detail", daemon=True)
        if len(model.gaussians) > most_in_view:
            self.maker.start()

    def model_for(self, camera: Camera) -> Model:
        """The finest level that shows few enough Gaussians to this camera; else the coarsest."""
        if not self._levels:
            return self._model
        coarsest = self._levels[-1].model
        rows = rows_in_view(coarsest, camera)
        for level in self._levels:
            in_view = level.stands_for if rows is None else level.stands_for[rows]
            if in_view.sum() <= self._most:
                return level.model
        return coarsest

    @torch.no_grad()
    def _make(self) -> None:
        """The levels, from the finest to the coarsest."""
        models, members = [self._model], []
        while len(models[-1].gaussians) > self._most:
            model = models[-1]
            finer = len(model.gaussians)
            coarse = merged(model.gaussians, max(finer // LEVEL_FACTOR, min(self._most, finer - 1)))
            residuals = model.temperature_residuals
            models.append(
                replace(
                    model,
                    gaussians=coarse.gaussians,
                    neighbours=None,
                    temperature_residuals=None if residuals is None else coarse.averaged(residuals),
                )
            )
            members.append(coarse.of)
        self._levels = [
            DetailLevel(model, _counted(members[number:], len(models[-1].gaussians)))
            for number, model in enumerate(models)
        ]


def _counted(members: Sequence[Tensor], coarsest: int) -> Float[Tensor, " m"]:
    """How many Gaussians of a level each of the coarsest stands for.

    Args:
        members: which Gaussian of the next level each stands in, from this level on.
        coarsest: number of Gaussians of the coarsest level.
    """
    if not members:
        return torch.ones(coarsest)
    of = members[0]
    for coarser in members[1:]:
        of = coarser[of]
    return of.bincount(minlength=coarsest).float()
