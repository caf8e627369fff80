"""Adam (D. P. Kingma, J. Ba, ICLR 2015)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.system.operation import operation

BETA1, BETA2 = 0.9, 0.999
"""Decay rates of the moments."""

MOMENTS = ("exp_avg", "exp_avg_sq")
"""Running means of a gradient and of its squares, by the names that torch gives them."""

_STATE = ("step", *MOMENTS)


@dataclass
class ParameterGroup:
    """Parameters that share a learning rate: leaves of the graph, of one type on one device.

    Attributes:
        parameters: they may be replaced.
        initial_rate: learning rate that a schedule starts from.
        name: unique, where parameters are found by it.
        rate: learning rate of the next step.
    """

    parameters: list[Tensor]
    initial_rate: float
    name: str = ""
    rate: float = field(init=False)

    def __post_init__(self) -> None:
        self.rate = self.initial_rate


def _moved(
    result: None,
    parameters: list[Tensor],
    gradients: list[Tensor],
    means: list[Tensor],
    squares: list[Tensor],
    *others: object,
) -> Tensor:
    """What a check compares of ``move``: everything that it changes."""
    del result, gradients, others
    return torch.cat([tensor.flatten() for tensor in (*parameters, *means, *squares)])


@operation(measure=_moved)
def move(
    parameters: list[Tensor],
    gradients: list[Tensor],
    means: list[Tensor],
    squares: list[Tensor],
    counts: list[Tensor],
    rate: float,
    epsilon: float,
    skip: Float[Tensor, ""] | None,
) -> None:
    """One step of Adam, in place (Algorithm 1 of the paper), of each parameter θ with gradient g:

    m ← β₁ m + (1 − β₁) g,  v ← β₂ v + (1 − β₂) g²,
    θ ← θ − rate · m / (1 − β₁ᵗ) / (√(v / (1 − β₂ᵗ)) + ε)

    θ, g, m and v of each are of one size; t are the numbers of steps with this one. Nothing is
    moved where ``skip`` is not 0.
    """
    for theta, g, m, v, t in zip(parameters, gradients, means, squares, counts, strict=True):
        new_m = BETA1 * m + (1 - BETA1) * g
        new_v = BETA2 * v + (1 - BETA2) * g**2
        change = rate * new_m / (1 - BETA1**t) / ((new_v / (1 - BETA2**t)).sqrt() + epsilon)
        for tensor, new in ((theta, theta - change), (m, new_m), (v, new_v)):
            tensor.copy_(new if skip is None else torch.where(skip == 0, new, tensor))


class Adam:
    """Adam without weight decay; a parameter without a gradient stays where it is.

    ``torch.optim.Adam`` imports torch's compiler for its first step: 145 MB of memory, and more
    than a second.

    Attributes:
        groups: all parameters, with their rates.
        state: step count and moments of each parameter that has moved, by the names ``step``,
            ``exp_avg`` and ``exp_avg_sq``.
    """

    def __init__(self, groups: Iterable[ParameterGroup], epsilon: float = 1e-8) -> None:
        self.groups = list(groups)
        self.state: dict[Tensor, dict[str, Tensor]] = {}
        self._epsilon = epsilon

    def parameters(self) -> list[Tensor]:
        """The parameters of all groups, in order."""
        return [parameter for group in self.groups for parameter in group.parameters]

    def set_rates(self, factor: float) -> None:
        """Set all learning rates to this factor of the initial ones."""
        for group in self.groups:
            group.rate = factor * group.initial_rate

    @torch.no_grad()
    def step(self, good: Bool[Tensor, ""] | None = None) -> None:
        """Move the parameters. Where ``good`` is False, parameters, moments and step counts stay as
        they are; the host does not wait for it."""
        skip = None if good is None else (~good).float()
        moving = [
            (group, moved)
            for group in self.groups
            if (moved := [each for each in group.parameters if each.grad is not None])
        ]
        counts = [self._state_of(each)["step"] for _, moved in moving for each in moved]
        if not counts:
            return
        torch._foreach_add_(counts, 1)
        for group, moved in moving:
            gradients = [each.grad for each in moved if each.grad is not None]
            means, squares, own_counts = (
                [self.state[each][name] for each in moved] for name in (*MOMENTS, "step")
            )
            move(moved, gradients, means, squares, own_counts, group.rate, self._epsilon, skip)
        if skip is not None:
            torch._foreach_sub_(counts, [skip] * len(counts))

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for parameter in self.parameters():
            parameter.grad = None

    def moments(self, parameters: Mapping[Any, Tensor]) -> dict[str, Tensor]:
        """Moments and step counts of parameters by their keys: ``KEY.step``, ``KEY.exp_avg`` and
        ``KEY.exp_avg_sq``, where a parameter has moved."""
        return {
            f"{key}.{name}": value
            for key, parameter in parameters.items()
            for name, value in self.state.get(parameter, {}).items()
        }

    def load_moments(self, parameters: Mapping[Any, Tensor], tensors: Mapping[str, Tensor]) -> None:
        """Take what ``moments`` gave, on the devices of these parameters. ValueError if moments are
        not theirs, which the kernels trust, or squares or steps are negative."""
        if unknown := set(tensors) - {f"{key}.{name}" for key in parameters for name in _STATE}:
            raise ValueError(f"moments {min(unknown)} of an unknown parameter")
        for key, parameter in parameters.items():
            found = {name: tensors.get(f"{key}.{name}") for name in _STATE}
            if any(value is not None for value in found.values()):
                self.state[parameter] = {
                    name: _checked_moment(f"{key}.{name}", value, parameter)
                    for name, value in found.items()
                }

    def _state_of(self, parameter: Tensor) -> dict[str, Tensor]:
        if parameter not in self.state:
            self.state[parameter] = {
                "step": torch.zeros((), device=parameter.device),
                **{name: torch.zeros_like(parameter) for name in MOMENTS},
            }
        return self.state[parameter]


def _checked_moment(name: str, value: Tensor | None, parameter: Tensor) -> Tensor:
    shape = torch.Size() if name.endswith(".step") else parameter.shape
    if value is None or value.shape != shape or value.dtype != torch.float32:
        raise ValueError(f"the moments {name} are not those of the parameter")
    if not name.endswith(".exp_avg") and not (value >= 0).all():
        raise ValueError(f"the moments {name} are negative")
    return value.to(parameter.device)
