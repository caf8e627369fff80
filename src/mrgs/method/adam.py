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
    """Parameters that share a learning rate.

    Attributes:
        parameters: leaves of the graph, all of one type on one device.
        initial_rate: learning rate that a schedule starts from.
        name: of the group.
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

    Args:
        parameters, gradients, means, squares: θ, g, m and v, of the same sizes; all but the
            gradients are changed.
        counts: t of each parameter, the number of steps with this one.
        rate: learning rate.
        epsilon: ε.
        skip: nothing is moved where it is not 0.
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

    Args:
        groups: all parameters.
        epsilon: added to the root of the mean square.

    Attributes:
        groups: as given; rates and parameters may be changed.
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
        """Move the parameters.

        Args:
            good: whether the step counts; where not, parameters, moments and step counts stay as
                they are. The device is not asked which of both it was. None if it counts.
        """
        skip = None if good is None else (~good).float()
        moving = [
            (group, [each for each in group.parameters if each.grad is not None])
            for group in self.groups
        ]
        counts = [self._state_of(each)["step"] for _, moved in moving for each in moved]
        if not counts:
            return
        torch._foreach_add_(counts, 1)
        for group, moved in moving:
            states = [self._state_of(each) for each in moved]
            gradients = [each.grad for each in moved if each.grad is not None]
            means, squares, own_counts = (
                [state[name] for state in states] for name in (*MOMENTS, "step")
            )
            if moved:
                move(moved, gradients, means, squares, own_counts, group.rate, self._epsilon, skip)
        if skip is not None:
            torch._foreach_sub_(counts, [skip] * len(counts))

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for parameter in self.parameters():
            parameter.grad = None

    def moments(self, parameters: Mapping[Any, Tensor]) -> dict[str, Tensor]:
        """Moments and step counts by name, ``KEY.step``, ``KEY.exp_avg`` and ``KEY.exp_avg_sq``;
        none of a parameter that has not moved yet.

        Args:
            parameters: of this optimizer, by their keys.
        """
        return {
            f"{key}.{name}": value
            for key, parameter in parameters.items()
            for name, value in self.state.get(parameter, {}).items()
        }

    def load_moments(self, parameters: Mapping[Any, Tensor], tensors: Mapping[str, Tensor]) -> None:
        """Take what ``moments`` gave, on the parameters' devices.

        The kernels trust their sizes, so moments of any other parameter are refused.

        Args:
            parameters: of this optimizer, by their keys.
            tensors: moments and step counts.

        Raises:
            ValueError: they are not those of the parameters, or the squares or steps are negative.
        """
        left = set(tensors)
        for key, parameter in parameters.items():
            state = {
                name: tensors[f"{key}.{name}"] for name in _STATE if f"{key}.{name}" in tensors
            }
            left -= {f"{key}.{name}" for name in state}
            if not state:
                continue
            _require_moments(key, parameter, state)
            self.state[parameter] = {
                name: value.to(parameter.device) for name, value in state.items()
            }
        if left:
            raise ValueError(f"moments {min(left)} of an unknown parameter")

    def _state_of(self, parameter: Tensor) -> dict[str, Tensor]:
        if parameter not in self.state:
            self.state[parameter] = {
                "step": torch.zeros((), device=parameter.device),
                **{name: torch.zeros_like(parameter) for name in MOMENTS},
            }
        return self.state[parameter]


def _require_moments(key: Any, parameter: Float[Tensor, "..."], state: dict[str, Tensor]) -> None:
    for name in _STATE:
        shape = torch.Size() if name == "step" else parameter.shape
        value = state.get(name)
        if value is None or value.shape != shape or value.dtype != torch.float32:
            raise ValueError(f"the moments {key}.{name} are not those of the parameter")
        if name != "exp_avg" and not (value >= 0).all():
            raise ValueError(f"the moments {key}.{name} are negative")
