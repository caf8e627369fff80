"""Density control: the one interface through which training adds, removes and moves Gaussians."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple, TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.errors import ConfigError
from mrgs.method.optimizer import GaussianOptimizer
from mrgs.render import ScreenPoints
from mrgs.scene import Gaussians
from mrgs.system.wording import shown

MOST_GAUSSIANS = 10**9
"""Kernels number them with 32 bits."""

StrategyState: TypeAlias = dict[str, Tensor]
"""What a strategy remembers between steps, by name; saved in checkpoints."""


class DensityStep(NamedTuple):
    """A training step, as a strategy sees it after the parameters have moved.

    Attributes:
        number: of the step, from 1.
        has_sky: whether training started with distant points, whose Gaussians are large.
        observed: sums of what ``observe`` found in the step's views; zeros where it was skipped.
        finite: False where the step did not count: loss or a gradient was not finite.
        generator: of every random choice, on the CPU.
    """

    number: int
    extent: float
    has_sky: bool
    observed: Mapping[str, Float[Tensor, " n"]]
    finite: Bool[Tensor, ""]
    generator: torch.Generator

    @property
    def skipped(self) -> bool:
        """Whether the step moved nothing. Reading it waits for a GPU: ask where it matters."""
        return not bool(self.finite)


class DensityUpdate(NamedTuple):
    """What a strategy returns after a step: the ``state`` that it remembers from now on; and
    ``counts`` for the log, by name, where it added, removed or moved Gaussians, else None."""

    state: StrategyState
    counts: Mapping[str, int] | None = None


@dataclass(frozen=True)
class Strategy(ABC):
    """Density control: its settings are fields, its state is passed in and out. Subclass it as a
    frozen dataclass and give an instance to ``train(..., strategy=...)``; to name it in a
    config.yaml, add a field ``name: Literal["..."]``, and it to
    ``mrgs.method.density.ConfiguredStrategy``. ``max_gaussians`` is the cap, at the start too."""

    max_gaussians: int = 5_000_000

    def __post_init__(self) -> None:
        if not 1 <= self.max_gaussians <= MOST_GAUSSIANS:
            raise ConfigError(
                f"max_gaussians must be from 1 to {MOST_GAUSSIANS:,}, not "
                f"{shown(self.max_gaussians)}",
                options=("max_gaussians",),
            )

    def settings(self) -> Mapping[str, object]:
        """What a resumed run must have as it began, by name: all fields. They are compared by their
        ``repr``, unless it contains an address (``at 0x...``)."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def initial_state(self, gaussians: Gaussians) -> StrategyState:
        """What the strategy remembers before the first step; nothing by default. All numbers are
        finite. Names, types, and shapes for a given number of Gaussians do not change: a run whose
        state has others cannot be resumed."""
        return {}

    def movable(self, gaussians: Gaussians) -> Bool[Tensor, " n"] | None:
        """The Gaussians that a step may move; None for all, which is the default."""
        return None

    def observe(self, passes: Sequence[ScreenPoints]) -> Mapping[str, Float[Tensor, " n"]]:
        """What the strategy records of a view, for each Gaussian; nothing by default. The names are
        the same for all views, whose sum over a step ``after_step`` gets. Of the view's projected
        centres, ``offset.grad``, if there is one, is the gradient of its loss."""
        return {}

    @abstractmethod
    def after_step(
        self, state: StrategyState, optimizer: GaussianOptimizer, step: DensityStep
    ) -> DensityUpdate:
        """Adapt the Gaussians; called once after every step.

        Change them through the optimizer (``replace_rows``, ``limit_opacities``), after everything
        else has been computed, and leave ``state`` as it is: the call is repeated where a GPU's
        memory did not suffice.

        Args:
            state: what the last call returned.
            step: the step that was just done.
        """

    def rescaled(self, factor: float) -> Strategy:
        """The same settings for a schedule of ``factor`` times as many steps."""
        return self

    def with_batch(self, batch: int) -> Strategy:
        """The same settings where each step has ``batch`` views instead of one, and a schedule
        already rescaled to fewer steps."""
        return self
