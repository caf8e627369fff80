from __future__ import annotations

import numpy as np
import pytest
import torch

from mrgs_thermonerf.networks import CHANNELS, encode

RESOLUTIONS = torch.tensor([2, 3, 9, 40])
SIZES = [27, 64, 256, 128]
"""The first two levels are dense, the others hashed."""
OFFSETS = torch.tensor([0, *SIZES]).cumsum(0)


def naive(points: torch.Tensor, table: torch.Tensor) -> torch.Tensor:
    """The definition, one corner at a time."""
    rows = []
    for point in points.tolist():
        row = []
        for level, resolution in enumerate(RESOLUTIONS.tolist()):
            place = [min(max(value, 0.0), 1.0) * resolution for value in point]
            cell = [min(int(value), resolution - 1) for value in place]
            total = torch.zeros(CHANNELS, dtype=table.dtype)
            for corner in np.ndindex(2, 2, 2):
                x, y, z = (cell[axis] + corner[axis] for axis in range(3))
                if (resolution + 1) ** 3 <= SIZES[level]:
                    entry = x + (resolution + 1) * (y + (resolution + 1) * z)
                else:
                    entry = (x ^ (y * 2654435761) % 2**32 ^ (z * 805459861) % 2**32) % SIZES[level]
                near = [place[axis] - cell[axis] for axis in range(3)]
                weight = np.prod(
                    [near[axis] if corner[axis] else 1 - near[axis] for axis in range(3)]
                )
                total = total + weight * table[OFFSETS[level] + entry]
            row.append(total)
        rows.append(torch.cat(row))
    return torch.stack(rows)


def example(count: int, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=generator, dtype=dtype)
    return points, torch.randn(sum(SIZES), CHANNELS, generator=generator, dtype=dtype)


@pytest.mark.parametrize(
    "dtype", [torch.float32, pytest.param(torch.float64, marks=pytest.mark.slow)]
)
def test_features_and_gradients_are_those_of_a_naive_loop(dtype):
    points, table = example(70, dtype)  # more than one block
    points[:4] = torch.tensor([[0, 0, 0], [1, 1, 1], [-0.5, 0.5, 2], [0.5, 1, 0]], dtype=dtype)
    upstream = torch.randn(
        70, CHANNELS * len(SIZES), generator=torch.Generator().manual_seed(1), dtype=dtype
    )
    found = []
    for features_of in (naive, lambda *inputs: encode(*inputs, RESOLUTIONS, OFFSETS)):
        entries = table.clone().requires_grad_()
        features = features_of(points, entries)
        features.backward(upstream)
        found.append((features.detach(), entries.grad))
    torch.testing.assert_close(*found)


def test_what_is_not_a_place_gets_some_entry():
    _, table = example(1, torch.float32)
    table.requires_grad_()
    points = torch.tensor([[torch.nan, torch.inf, -torch.inf]])
    encode(points, table, RESOLUTIONS, OFFSETS).sum().backward()
    assert table.grad.shape == table.shape
