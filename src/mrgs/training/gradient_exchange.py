"""What the processes of a training tell each other in every step."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.distributed.processes import Processes
from mrgs.distributed.sums import Summand, sum_over_processes
from mrgs.training.state import TrainingState
from mrgs.training.view_sums import ViewSums


class GradientExchange:
    """Adds to the gradients and measurements of this process those of all others.

    After it all processes hold the same numbers, and so decide alike from then on.

    Args:
        processes: that train together.
        batch: views per step of all processes.
        share: which of them this process renders.
    """

    def __init__(self, processes: Processes, batch: int, share: slice) -> None:
        self._processes = processes
        self._batch = batch
        self._share = share
        self._wishes_to_stop = False
        self._stops = False

    def ask_to_stop(self) -> None:
        """Have all processes stop after the next step."""
        self._wishes_to_stop = True

    @property
    def stops(self) -> bool:
        """Whether one of the processes had asked to stop before the last step."""
        return self._stops

    def __call__(self, state: TrainingState, found: ViewSums) -> ViewSums:
        """Sum gradients and measurements over all processes, in the order of their numbers.

        Args:
            state: whose parameters have the gradients of this process's views; they get the sums.
            found: in these views.

        Raises:
            LinkError, PeerError: another process is gone; the gradients are as they were.
        """
        gaussians = list(state.gaussian_optimizer.gaussians.tensors().values())
        layers = state.layer_optimizer.parameters()
        terms = [term.name for term in state.terms]
        numbers = found.to_tensor(terms)
        wish = torch.tensor([float(self._wishes_to_stop)])
        residuals = self._residuals_of(found)
        sums = sum_over_processes(
            self._processes,
            [Summand(each, each.grad) for each in gaussians]
            + [Summand(each, each) for each in found.observed.values()],
            [Summand(each, each.grad) for each in layers]
            + [Summand(each, each) for each in (numbers, wish, residuals)],
        )
        *layer_sums, numbers_sum, wishes, all_residuals = sums.whole
        assert numbers_sum is not None
        assert wishes is not None
        assert all_residuals is not None
        for parameter, total in zip(
            [*gaussians, *layers], [*sums.by_row[: len(gaussians)], *layer_sums], strict=True
        ):
            parameter.grad = total
        observed = zip(found.observed, sums.by_row[len(gaussians) :], strict=True)
        self._stops = bool(wishes > 0)
        result = ViewSums.from_tensor(
            numbers_sum,
            terms,
            {name: total for name, total in observed if total is not None},
            state.device,
        )
        for view, *residual in all_residuals:
            if view > 0:
                result.residuals[int(view) - 1] = torch.stack(residual).to(state.device)
        return result

    def _residuals_of(self, found: ViewSums) -> Float[Tensor, "b 3"]:
        """A row for each view of the step: its number from 1 and its residual; zeros for the views
        of other processes, and for those without one."""
        rows = torch.zeros(self._batch, 3)
        for place, (view, residual) in enumerate(found.residuals.items(), self._share.start):
            rows[place, 0], rows[place, 1:] = view + 1, residual
        return rows
