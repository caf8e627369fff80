"""Sums over processes in the order of their numbers, so that the bits do not depend on which of
them is faster.

A view touches the rows of the Gaussians that it shows, so only those travel. Each process sums a
share of the rows that any process has touched, and sends the sums to the others: with f the share
of the rows that a view touches and u that of all views together, a process sends about
(f + u) · (n − 1)/n of the rows, however many processes there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from mrgs.distributed.processes import Processes

_BITS = 8


class Summand(NamedTuple):
    """What a process adds to a sum.

    Attributes:
        like: a tensor of the shape and device of the sum, the same shape on all processes.
        value: None if this process has nothing to add.
    """

    like: Tensor
    value: Tensor | None


class ProcessSums(NamedTuple):
    """Sums over all processes, each None where no process has added anything.

    Attributes:
        by_row: of tensors with one row for each Gaussian.
        whole: of all others.
    """

    by_row: list[Tensor | None]
    whole: list[Tensor | None]


def sum_over_processes(
    processes: Processes, by_row: Sequence[Summand], whole: Sequence[Summand]
) -> ProcessSums:
    """Sum tensors over all processes.

    Args:
        processes: that all call this with tensors of the same shapes.
        by_row: float32 tensors with the same number of rows; rows of zeros do not travel.
        whole: float32 tensors that travel as they are.

    Raises:
        LinkError, PeerError: another process is gone.
    """
    count = len(by_row[0].like)
    touched = _touched(by_row, count)
    present = [each.value is not None for each in (*by_row, *whole)]
    control = torch.tensor(present, dtype=torch.float32)
    values = [_value_of(each).flatten().to(processes.device) for each in whole]
    packed = _packed(touched).view(torch.float32).to(processes.device)
    parts = [control.to(processes.device), *values, packed]
    gathered = processes.all_gather(torch.cat(parts)).split([len(part) for part in parts], dim=1)
    anywhere = gathered[0].bool().any(dim=0).tolist()
    masks = _unpacked(gathered[-1].contiguous().view(torch.uint8), count)
    totals = [_in_order(each) for each in gathered[1:-1]]
    added = [each for each, is_there in zip(by_row, anywhere, strict=False) if is_there]
    summed = iter(_row_sums(processes, added, masks))
    return ProcessSums(
        [next(summed) if is_there else None for is_there in anywhere[: len(by_row)]],
        [
            total.view_as(each.like).to(each.like.device) if is_there else None
            for each, total, is_there in zip(whole, totals, anywhere[len(by_row) :], strict=True)
        ],
    )


def _row_sums(
    processes: Processes, added: Sequence[Summand], masks: Bool[Tensor, "p n"]
) -> list[Tensor]:
    """The sums of tensors, of whose rows each process has touched those in its mask."""
    union = masks.any(dim=0)
    rows = union.nonzero()[:, 0]
    share = -(-len(rows) // processes.count)
    place = union.cumsum(0) - 1  # of each row among those that travel
    places = [place[mask] for mask in masks]
    cuts = torch.arange(processes.count + 1, device=rows.device) * share
    # Of each process's rows, how many belong to each process's share.
    counts = torch.stack([torch.searchsorted(each, cuts).diff() for each in places]).tolist()
    own = rows[places[processes.rank]]
    columns = [_as_rows(_value_of(each))[own.to(each.like.device)] for each in added]
    sent = torch.cat(columns, dim=1).to(processes.device)
    received = [each[processes.rank] for each in counts]
    pieces = processes.all_to_all(sent, counts[processes.rank], received).split(received)
    total = sent.new_zeros(share, sent.shape[1])
    for of_one, piece in zip(places, pieces, strict=True):
        start = processes.rank * share
        inside = of_one[(of_one >= start) & (of_one < start + share)] - start
        total.index_add_(0, inside, piece)
    sums = processes.all_gather(total).flatten(0, 1)[: len(rows)]
    blocks = sums.split([column.shape[1] for column in columns], dim=1)
    return [_scattered(each.like, rows, block) for each, block in zip(added, blocks, strict=True)]


def _scattered(like: Tensor, rows: Int64[Tensor, " u"], block: Float[Tensor, "u c"]) -> Tensor:
    """Rows among zeros."""
    result = _as_rows(like.new_zeros(like.shape))
    return result.index_copy_(0, rows.to(like.device), block.to(like.device)).view_as(like)


def _as_rows(tensor: Tensor) -> Tensor:
    """The same numbers as a matrix with one row for each Gaussian."""
    return tensor.flatten(1) if tensor.dim() > 1 else tensor[:, None]


def _value_of(each: Summand) -> Tensor:
    return torch.zeros_like(each.like) if each.value is None else each.value.detach()


def _in_order(values: Float[Tensor, "p n"]) -> Float[Tensor, " n"]:
    """The sum over processes, one after the other."""
    total = values[0].clone()
    for value in values[1:]:
        total += value
    return total


def _touched(by_row: Sequence[Summand], count: int) -> Bool[Tensor, " n"]:
    """The rows with a value that is not 0; NaN is not."""
    touched = torch.zeros(count, dtype=torch.bool, device=by_row[0].like.device)
    for each in by_row:
        if each.value is not None:
            touched |= _as_rows(each.value != 0).any(dim=1)
    return touched


def _packed(mask: Bool[Tensor, " n"]) -> UInt8[Tensor, " b"]:
    """Eight to a byte, in a multiple of four bytes."""
    padded = torch.nn.functional.pad(mask, (0, -len(mask) % (4 * _BITS)))
    powers = 2 ** torch.arange(_BITS, dtype=torch.uint8, device=mask.device)
    return (padded.view(-1, _BITS) * powers).sum(dim=1, dtype=torch.uint8)


def _unpacked(packed: UInt8[Tensor, "p b"], count: int) -> Bool[Tensor, "p n"]:
    powers = 2 ** torch.arange(_BITS, dtype=torch.uint8, device=packed.device)
    return ((packed[:, :, None] & powers) != 0).flatten(1)[:, :count]
