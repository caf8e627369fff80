from __future__ import annotations

import pytest
import torch

from mrgs.distributed.sums import Summand, sum_over_processes
from tests.helpers.threaded_processes import together

COUNT = 37
"""Gaussians; not a multiple of what is packed into a byte, nor of the number of processes."""


def values_of(rank: int) -> dict[str, torch.Tensor | None]:
    """What a process adds: few rows; one tensor only on one process, one nowhere."""
    generator = torch.Generator().manual_seed(rank)
    rows = torch.randperm(COUNT, generator=generator)[:9]
    means, colours = torch.zeros(COUNT, 3), torch.zeros(COUNT, 4, 2)
    means[rows] = torch.randn(9, 3, generator=generator)
    colours[rows[:5]] = torch.randn(5, 4, 2, generator=generator)
    if rank == 2:
        means[11, 1] = float("nan")
    weight = torch.randn(2, 3, generator=generator)
    return {
        "means": means,
        "colours": colours,
        "seen": (means != 0).any(dim=1).float(),
        "single": colours * 2 if rank == 1 else None,
        "nowhere": None,
        "weight": weight,
        "bias": weight[0] if rank == 1 else None,
        "unused": None,
    }


def in_order(name: str, count: int) -> torch.Tensor:
    """The sum over processes, one after the other."""
    total, *others = [
        value for rank in range(count) if (value := values_of(rank)[name]) is not None
    ]
    for other in others:
        total = total + other
    return total


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_sums_are_those_in_the_order_of_the_processes_bit_by_bit(count):
    likes = {
        "means": (COUNT, 3), "colours": (COUNT, 4, 2), "seen": (COUNT,), "single": (COUNT, 4, 2),
        "nowhere": (COUNT, 0, 1), "weight": (2, 3), "bias": (3,), "unused": (1,),
    }  # fmt: skip

    def add(processes):
        values = values_of(processes.rank)
        summands = [Summand(torch.empty(shape), values[name]) for name, shape in likes.items()]
        sums = sum_over_processes(processes, summands[:5], summands[5:])
        return dict(zip(likes, [*sums.by_row, *sums.whole], strict=True))

    for found in together(add, count):
        absent = {"nowhere", "unused"} | ({"single", "bias"} if count == 1 else set())
        assert {name for name, value in found.items() if value is None} == absent
        for name in likes.keys() - absent:
            torch.testing.assert_close(
                found[name], in_order(name, count), rtol=0, atol=0, equal_nan=True
            )


def test_rows_of_zeros_do_not_travel(monkeypatch):
    sent = {}

    def add(processes):
        exchange = processes.all_to_all

        def counted(rows, *counts):
            sent[processes.rank] = len(rows)
            return exchange(rows, *counts)

        processes.all_to_all = counted
        values = values_of(processes.rank)
        sum_over_processes(processes, [Summand(values["means"], values["means"])], [])

    together(add, 2)
    assert sent == {0: 9, 1: 9}
