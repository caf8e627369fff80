from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mrgs.field.appearance import ColorHead, OrthogonalExtraction, ThermalFeatureHead, reject


@settings(deadline=None)
@given(
    seed=st.integers(0, 2**31), width=st.integers(1, 30), scale=st.sampled_from([1e-3, 1.0, 1e3])
)
def test_rejected_embedding_is_orthogonal_and_the_rest_is_parallel(seed, width, scale):
    generator = torch.Generator().manual_seed(seed)
    embedding = torch.randn(7, width, dtype=torch.float64, generator=generator)
    direction = scale * torch.nn.functional.normalize(
        torch.randn(7, width, dtype=torch.float64, generator=generator), dim=1
    )
    orthogonal = reject(embedding, direction)
    unit = direction / scale
    # The 1e-8 beside ‖SH'‖² leaves that share of the projection behind.
    assert (
        (orthogonal * unit).sum(dim=1).abs() <= 2e-8 / scale**2 * embedding.norm(dim=1) + 1e-12
    ).all()
    removed = embedding - orthogonal
    torch.testing.assert_close((removed * unit).sum(dim=1, keepdim=True) * unit, removed)


def test_a_vanishing_direction_removes_nothing():
    embedding = torch.randn(3, 24)
    assert torch.equal(reject(embedding, torch.zeros(3, 24)), embedding)


def test_extraction_is_the_equation():
    extraction = OrthogonalExtraction(24).double()
    embedding, sh = (
        torch.randn(5, 24, dtype=torch.float64),
        torch.randn(5, 16, 3, dtype=torch.float64),
    )
    for row, e_t in enumerate(extraction(embedding, sh)):
        direction = extraction.phi_sh.weight @ sh[row].flatten() + extraction.phi_sh.bias
        projection = embedding[row] @ direction / (direction @ direction) * direction
        expected = extraction.phi_e.weight @ (embedding[row] - projection) + extraction.phi_e.bias
        torch.testing.assert_close(e_t, expected)


def test_extraction_gradient():
    extraction = OrthogonalExtraction(6).double()
    embedding = torch.randn(3, 6, dtype=torch.float64, requires_grad=True)
    sh = torch.randn(3, 16, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(extraction, (embedding, sh))


def test_color_head_reads_embedding_and_direction_and_starts_small():
    torch.manual_seed(0)
    head = ColorHead(24, 4, 128, 0.01)
    embedding, directions = (
        torch.randn(20, 24),
        torch.nn.functional.normalize(torch.randn(20, 3), dim=1),
    )
    residual = head(embedding, directions)
    assert residual.shape == (20, 3)
    assert residual.abs().max() < 0.02
    assert not torch.allclose(residual, head(embedding, -directions), atol=1e-6)
    assert not torch.allclose(residual, head(-embedding, directions), atol=1e-6)


def test_heads_take_no_rows():
    assert ColorHead(6, 1, 8, 1.0)(torch.empty(0, 6), torch.empty(0, 3)).shape == (0, 3)


def test_positions_get_no_gradient_from_their_encoding():
    head = ThermalFeatureHead(24, 10, 16, 32)
    e_t, positions = torch.randn(4, 24, requires_grad=True), torch.rand(4, 3, requires_grad=True)
    head(e_t, positions).sum().backward()
    assert positions.grad is None
    assert e_t.grad is not None
