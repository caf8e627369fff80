from __future__ import annotations

import math

import pytest
import torch

from mrgs.field.encoding import fourier_embedding, position_frame, positional_encoding


def test_encoding_is_the_papers_concatenation():
    x = torch.tensor([[0.3, -0.7]], dtype=torch.float64)
    expected = [
        function(2**n * math.pi * value)
        for n in range(3)
        for function in (math.sin, math.cos)
        for value in (0.3, -0.7)
    ]
    torch.testing.assert_close(
        positional_encoding(x, 3), torch.tensor([expected], dtype=torch.float64)
    )


def test_encoding_without_frequencies_is_empty():
    assert positional_encoding(torch.zeros(4, 3), 0).shape == (4, 0)


def test_encoding_gradient():
    x = torch.randn(5, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: positional_encoding(x, 4), x)


def test_frame_ignores_a_few_far_points():
    torch.manual_seed(0)
    positions = torch.rand(1000, 3) * 2 - 1
    positions[:5] *= 1000
    center, scale = position_frame(positions)
    inside = ((positions - center) / scale).abs().amax(dim=1) <= 1
    assert inside.sum() == 970


@pytest.mark.parametrize("count", [0, 1, 4])
def test_frame_of_degenerate_points_is_finite(count):
    center, scale = position_frame(torch.full((count, 3), 7.0))
    assert center.isfinite().all()
    assert scale > 0


def test_embedding_starts_at_fourier_features_with_little_noise():
    torch.manual_seed(0)
    positions = torch.rand(500, 3)
    noise = fourier_embedding(positions, 24) - positional_encoding(positions, 4)
    assert noise.std().item() == pytest.approx(1e-4, rel=0.05)
