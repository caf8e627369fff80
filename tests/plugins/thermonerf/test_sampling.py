from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mrgs_thermonerf.model import Spacing, even_edges, resample

weights = st.lists(st.floats(0, 1, width=32), min_size=2, max_size=20)


@given(st.floats(0.01, 1), st.floats(0.5, 5), st.floats(10, 1000))
def test_spacing_runs_from_near_to_far(near, middle, far):
    distances = Spacing(near, middle, far).distance(torch.linspace(0, 1, 50, dtype=torch.float64))
    assert distances[0].item() == pytest.approx(near)
    assert distances[-1].item() == pytest.approx(far)
    assert (distances.diff() > 0).all()


@given(st.integers(1, 40), st.none() | st.integers(0, 99))
def test_even_edges_ascend_and_keep_their_ends(count, seed):
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    edges = even_edges(3, count, generator, torch.zeros(0))
    assert (edges.diff(dim=1) > 0).all()
    assert edges[:, 0].eq(0).all()
    assert edges[:, -1].eq(1).all()


@given(weights, st.integers(1, 40), st.none() | st.integers(0, 99))
def test_resampled_edges_ascend_and_cover_the_same_range(values, count, seed):
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    row = torch.tensor([values])
    edges = torch.linspace(0, 1, len(values) + 1)[None]
    found = resample(edges, row, count, generator)
    assert found.shape == (1, count + 1)
    assert (found.diff(dim=1) >= 0).all()
    torch.testing.assert_close(found[:, [0, -1]], edges[:, [0, -1]])


@given(weights)
def test_each_new_interval_holds_the_same_share_of_the_weight(values):
    count = 13
    padded = torch.tensor([values], dtype=torch.float64)
    edges = torch.linspace(0, 1, len(values) + 1, dtype=torch.float64).square()[None]
    found = resample(edges, padded, count, None)[0]
    share = (padded[0] + 0.01 / len(values)) / (padded[0] + 0.01 / len(values)).sum()
    for low, high in pairwise(found):
        overlap = (torch.minimum(high, edges[0, 1:]) - torch.maximum(low, edges[0, :-1])).clamp(
            min=0
        )
        held = (share * overlap / (edges[0, 1:] - edges[0, :-1])).sum().item()
        assert held == pytest.approx(1 / count, abs=1e-9)


def test_samples_gather_where_the_weight_is():
    row = torch.zeros(1, 10)
    row[0, 6] = 1.0
    found = resample(torch.linspace(0, 1, 11)[None], row, 20, None)[0]
    assert ((found >= 0.6) & (found <= 0.7)).sum() >= 19
