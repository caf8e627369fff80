"""What the views of a step have measured, added up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

LOSS = "loss"
THERMAL_ERROR = "thermal_error"
_TERM = "term."


@dataclass
class ViewSums:
    """Sums over views; not every view has every number.

    Attributes:
        totals: sums by name: ``loss``, ``thermal_error``, and ``term.NAME`` of each term.
        counts: how many views each of them is the sum of.
        observed: what the strategy has observed, [N] each.
        residuals: of the thermal photos, by the numbers of their views, where drift is modelled;
            not summed.
    """

    totals: dict[str, Tensor] = field(default_factory=dict)
    counts: dict[str, Tensor | float] = field(default_factory=dict)
    observed: dict[str, Tensor] = field(default_factory=dict)
    residuals: dict[int, Float[Tensor, "2"]] = field(default_factory=dict)

    def add(
        self,
        loss: Float[Tensor, ""],
        terms: Mapping[str, Float[Tensor, ""]],
        thermal_error: Float[Tensor, ""] | None,
        observed: Mapping[str, Float[Tensor, " n"]],
    ) -> None:
        """Add a view.

        Args:
            loss: L_total.
            terms: unweighted, by name.
            thermal_error: NaN if no pixel is valid, None without a thermal photo.
            observed: what the strategy has observed.
        """
        self._add(LOSS, loss.detach(), 1.0)
        for name, value in terms.items():
            self._add(f"{_TERM}{name}", value.detach(), 1.0)
        if thermal_error is not None:
            is_known = ~thermal_error.isnan()
            self._add(THERMAL_ERROR, torch.where(is_known, thermal_error, 0), is_known.float())
        for name, value in observed.items():
            self.observed[name] = self.observed[name] + value if name in self.observed else value

    def _add(self, name: str, value: Tensor, count: Tensor | float) -> None:
        has_some = name in self.totals
        self.totals[name] = self.totals[name] + value if has_some else value
        self.counts[name] = self.counts[name] + count if has_some else count

    def mean(self, name: str) -> Float[Tensor, ""] | None:
        """Mean over the views that have a number; None where none of them has."""
        return self.totals[name] / self.counts[name] if name in self.totals else None

    @property
    def terms(self) -> dict[str, Float[Tensor, ""]]:
        """Means of the unweighted terms, by name."""
        names = [name for name in self.totals if name.startswith(_TERM)]
        return {name.removeprefix(_TERM): self.totals[name] / self.counts[name] for name in names}
