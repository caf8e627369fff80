"""The radiance field: colours and temperatures of all Gaussians, forward and backward; and the
neighbour search."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from benchmarks.plan import Case
from benchmarks.timing import Stages, Timing
from benchmarks.workload import gaussians, radiance_field, room
from mrgs.field import FieldConfig, nearest_neighbours
from mrgs.method.config import TrainConfig, make_config


def stages(case: Case) -> Stages:
    """The colour head, and the temperature branch with and without the heat transformation."""
    assert case.gaussians is not None
    config = make_config("mrgs", "paper")
    full = Heads(case.gaussians, config)
    without_heat = Heads(
        case.gaussians, replace(config, field=replace(config.field, fourier=False))
    )
    return Stages(
        [
            Timing("colours", lambda _: full.colors()),
            Timing("temperatures", lambda _: full.temperatures()),
            Timing(
                "temperatures without heat transformation", lambda _: without_heat.temperatures()
            ),
        ]
    )


def neighbours(case: Case) -> Stages:
    """The search for as many neighbours as the heat transformation needs."""
    assert case.gaussians is not None
    means, k = room(case.gaussians)["means"], FieldConfig().neighbours_k
    return Stages([Timing(f"{k} nearest neighbours", lambda _: nearest_neighbours(means, k))])


class Heads:
    """A field and its Gaussians; each method returns the gradients of the field and of all that it
    reads."""

    def __init__(self, count: int, config: TrainConfig) -> None:
        self._field = radiance_field(count, config)
        self._gaussians = gaussians(count, self._field, config)
        k = config.field.neighbours_k
        self._neighbours = nearest_neighbours(self._gaussians.means, k) if k > 0 else None
        tensors = [tensor for tensor in self._gaussians.tensors().values() if tensor.numel() > 0]
        self._inputs = [*(tensor.requires_grad_() for tensor in tensors), *self._field.parameters()]
        self._camera_position = torch.zeros(3)

    def colors(self) -> tuple[Tensor | None, ...]:
        """Through c + ĉ, all degrees of the harmonics in use."""
        return self._gradients(self._field.colors(self._gaussians, self._camera_position, 3))

    def temperatures(self) -> tuple[Tensor | None, ...]:
        """Through t + t̂."""
        return self._gradients(
            self._field.temperatures(self._gaussians, self._neighbours, self._camera_position, 3)
        )

    def _gradients(self, values: Tensor) -> tuple[Tensor | None, ...]:
        return torch.autograd.grad(values.sum(), self._inputs, allow_unused=True)
