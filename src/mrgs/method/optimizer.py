"""Adam over the Gaussians. Rows change here alone: parameters and moments stay together."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from mrgs.errors import ConfigError
from mrgs.method.adam import MOMENTS, Adam, ParameterGroup
from mrgs.scene import THERMAL, Gaussians
from mrgs.system.strict_yaml import MOST_RATE, require_within

_ADAM = "adam."


@dataclass(frozen=True)
class OptimizerConfig:
    """Learning rates; those of the Gaussians are 3DGS's.

    Attributes:
        means: at the first step, in scene extents; decays log-linearly to ``means_final`` at the
            last step.
        means_final: at the last step, in scene extents.
        opacities: of the opacity logits of all modalities.
        sh_dc: of the colour coefficient of degree 0, and of that of any further modality.
        sh_rest: of their coefficients of higher degrees.
        temperature_rest: of the temperature's higher degrees, where it has them.
        embedding, uncertainty: of e_m, and of ψ.
        slowdown_from: share of the training after which all rates but that of the means fall.
        slowdown_to: the share of the rates that is left at the last step.
    """

    means: float = 1.6e-4
    means_final: float = 1.6e-6
    quats: float = 1e-3
    log_scales: float = 5e-3
    opacities: float = 0.05
    sh_dc: float = 2.5e-3
    sh_rest: float = 1.25e-4
    temperature_dc: float = 2.5e-3
    temperature_rest: float = 1.25e-4
    embedding: float = 5e-3
    heads: float = 5e-4
    uncertainty: float = 1e-3
    slowdown_from: float = 1.0
    slowdown_to: float = 0.1

    def __post_init__(self) -> None:
        require_within(self, self._rates(), 0, MOST_RATE, "the learning rate {}")
        require_within(self, ("slowdown_from", "slowdown_to"), 0, 1, "the share {}")
        if self.slowdown_to == 0:
            raise ConfigError("the share slowdown_to must be above 0: the rates fall log-linearly")
        if self.means == 0 or self.means_final == 0:
            raise ConfigError(
                "the learning rates means and means_final must be above 0: one decays to the other"
            )

    def faster(self, factor: float) -> OptimizerConfig:
        """All rates times a factor."""
        return replace(self, **{name: factor * getattr(self, name) for name in self._rates()})

    @classmethod
    def _rates(cls) -> list[str]:
        names = [field.name for field in fields(cls)]
        return [name for name in names if not name.startswith("slowdown")]

    def means_at(self, progress: float) -> float:
        """Learning rate of the means after this share of the training, in scene extents."""
        start, end = math.log(self.means), math.log(self.means_final)
        return math.exp((1 - progress) * start + progress * end)

    def slowdown_at(self, progress: float) -> float:
        """Factor on all rates but the means' at this share of the training; log-linear."""
        if progress <= self.slowdown_from:
            return 1.0
        return self.slowdown_to ** ((progress - self.slowdown_from) / (1 - self.slowdown_from))

    def of(self, parameter: str) -> float:
        """Learning rate of a tensor of ``Gaussians``, by its name."""
        group, _, modality = parameter.partition(".")
        name = {
            "opacity_logit": "opacities",
            "sh_dc": "temperature_dc" if modality == THERMAL.name else "sh_dc",
            "sh_rest": "temperature_rest" if modality == THERMAL.name else "sh_rest",
        }.get(group, group)
        rate: float = getattr(self, name)
        return rate


def are_finite(loss: Float[Tensor, ""], gradients: Sequence[Tensor]) -> Bool[Tensor, ""]:
    """Whether the loss and the norm of each gradient are finite, on their device. A norm keeps NaN
    and infinity, and is infinite where a square is, which Adam would keep for good."""
    norms = torch._foreach_norm(list(gradients)) if gradients else ()
    return torch.stack([loss.detach(), *norms]).isfinite().all()


class GaussianOptimizer:
    """Adam over the parameters of the Gaussians; the scene's extent multiplies the learning rate of
    the means. Tensors of ``gaussians`` are the parameters."""

    def __init__(self, gaussians: Gaussians, config: OptimizerConfig, extent: float) -> None:
        self._config, self._extent = config, extent
        self.gaussians = gaussians.with_tensors(
            {name: t.detach().requires_grad_() for name, t in gaussians.tensors().items()}
        )
        groups = [
            ParameterGroup([tensor], config.of(name), name)
            for name, tensor in self.gaussians.tensors().items()
            if tensor.numel() > 0
        ]
        self._adam = Adam(groups, epsilon=1e-15)

    def step(self, progress: float, good: Bool[Tensor, ""] | None = None) -> None:
        """One Adam step from the gradients, which are then cleared; ``progress`` is the share of
        the training done. Where ``good`` is False, nothing is moved."""
        self._adam.set_rates(self._config.slowdown_at(progress))
        self._group("means").rate = self._config.means_at(progress) * self._extent
        self._adam.step(good)
        self.zero_grad()

    def zero_grad(self) -> None:
        """Forget the gradients."""
        self._adam.zero_grad()

    def hold(self, rows: Bool[Tensor, " n"]) -> None:
        """Forget some Gaussians' gradients: the next step moves them by their moments alone."""
        for gradient in self.gradients():
            gradient[rows] = 0

    def gradients(self) -> list[Tensor]:
        """Gradients of all parameters that have one."""
        tensors = self.gaussians.tensors().values()
        return [tensor.grad for tensor in tensors if tensor.grad is not None]

    def replace_rows(self, keep: Int64[Tensor, " k"], added: Gaussians) -> None:
        """Keep these rows, in this order, and append new ones, whose moments start at 0. All is
        built first: without enough memory, the optimizer is as it was."""
        built = {
            name: self._with_rows(name, keep, addition.detach())
            for name, addition in added.tensors().items()
        }
        for name, (new, moments) in built.items():
            old = self.gaussians.tensors()[name]
            self.gaussians.replace(name, new)
            if old.numel() == 0:
                continue
            self._group(name).parameters = [new]
            state = self._adam.state.pop(old, None)
            if state is not None:
                self._adam.state[new] = {**state, **moments}

    def _with_rows(
        self, name: str, keep: Int64[Tensor, " k"], addition: Float[Tensor, "a ..."]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """A parameter and its moments with the rows to keep and the new ones."""
        old = self.gaussians.tensors()[name]
        state = self._adam.state.get(old, {})
        moments = {
            moment: torch.cat([state[moment][keep], torch.zeros_like(addition)])
            for moment in MOMENTS
            if state
        }
        return torch.cat([old.detach()[keep], addition]).requires_grad_(), moments

    @torch.no_grad()
    def limit_opacities(self, maximum: float) -> None:
        """3DGS's opacity reset: bring every opacity down to ``maximum`` and clear its moments."""
        limit = math.log(maximum / (1 - maximum))
        for logits in self.gaussians.opacity_logits.values():
            logits.clamp_(max=limit)
            for moment in MOMENTS:
                if moment in self._adam.state.get(logits, {}):
                    self._adam.state[logits][moment].zero_()

    def state(self) -> dict[str, Tensor]:
        """Parameters and moments by name, for a checkpoint."""
        tensors = {name: tensor.detach() for name, tensor in self.gaussians.tensors().items()}
        return tensors | self._adam.moments(self._parameters())

    def load_moments(self, tensors: Mapping[str, Tensor]) -> None:
        """Take the moments of ``state()``. ValueError if they are not those of the parameters."""
        moments = {name: tensor for name, tensor in tensors.items() if name.startswith(_ADAM)}
        self._adam.load_moments(self._parameters(), moments)

    def _parameters(self) -> dict[str, Tensor]:
        """The parameters that move, by the prefix of their moments' names."""
        return {f"{_ADAM}{group.name}": group.parameters[0] for group in self._adam.groups}

    def _group(self, name: str) -> ParameterGroup:
        return next(group for group in self._adam.groups if group.name == name)
