from __future__ import annotations

from dataclasses import fields

import pytest
import torch
from jaxtyping import TypeCheckError

from mrgs.scene import Gaussians


def make(shares_opacity: bool = False) -> Gaussians:
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(7, *shape, generator=generator)

    return Gaussians(
        means=random(3),
        quats=random(4),
        log_scales=random(3),
        opacity_rgb_logit=random(1),
        opacity_thermal_logit=random(0 if shares_opacity else 1),
        sh_dc=random(1, 3),
        sh_rest=random(15, 3),
        temperature_dc=random(1, 1),
        temperature_rest=random(0, 1),
        embedding=random(24),
    )


def test_scales_and_opacities_are_read_through_their_logarithms():
    gaussians = make()
    assert len(gaussians) == 7
    torch.testing.assert_close(gaussians.scales.log(), gaussians.log_scales)
    torch.testing.assert_close(gaussians.opacity_rgb.logit(), gaussians.opacity_rgb_logit[:, 0])
    torch.testing.assert_close(
        gaussians.opacity_thermal.logit(), gaussians.opacity_thermal_logit[:, 0]
    )
    assert not torch.equal(gaussians.opacity_rgb, gaussians.opacity_thermal)


def test_without_a_thermal_opacity_the_one_opacity_serves_both():
    gaussians = make(shares_opacity=True)
    assert torch.equal(gaussians.opacity_thermal, gaussians.opacity_rgb)


def test_harmonics_are_the_degrees_in_order():
    gaussians = make()
    assert torch.equal(gaussians.sh[:, :1], gaussians.sh_dc)
    assert torch.equal(gaussians.sh[:, 1:], gaussians.sh_rest)


def test_shapes_are_checked():
    """By the hook of tests/conftest.py, in every test."""
    tensors = make().tensors()
    with pytest.raises(TypeCheckError, match="quats"):
        Gaussians(**{**tensors, "quats": tensors["quats"][:3]})


def test_tensors_are_all_the_fields_themselves():
    gaussians = make()
    tensors = gaussians.tensors()
    assert list(tensors) == [field.name for field in fields(Gaussians)]
    assert all(tensor is getattr(gaussians, name) for name, tensor in tensors.items())
