from __future__ import annotations

import pytest
import torch
from torch import Tensor

from mrgs.field import FieldConfig, RadianceField
from mrgs.method.start.start_points import (
    SMALLEST_DISTANCE,
    StartPoints,
    blended_apart,
    initial_gaussians,
)
from mrgs.scene import RGB, THERMAL, Gaussians, Modality

MODALITIES = (RGB, THERMAL)


def points_at(positions: Tensor) -> StartPoints:
    """Points that differ in everything."""
    generator = torch.Generator().manual_seed(1)
    count = len(positions)
    return StartPoints(
        positions,
        {each: torch.rand(count, each.channels, generator=generator) for each in MODALITIES},
        {each: 0.1 + 0.8 * torch.rand(count, generator=generator) for each in MODALITIES},
        torch.full((count,), torch.inf),
    )


def cloud(count: int) -> StartPoints:
    return points_at(torch.randn(count, 3, generator=torch.Generator().manual_seed(0)))


def start(
    points: StartPoints, shares_opacity=False, degree=0, cap=1_000, seed=0, **field
) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    points = points.at_most(cap, generator)
    apart = blended_apart(MODALITIES, shares_opacity)
    return initial_gaussians(points, RadianceField(FieldConfig(**field)), apart, degree)


@pytest.mark.parametrize("degree", [0, 3])
def test_one_gaussian_per_point_with_its_colour_temperature_and_opacity(degree):
    points = cloud(30)
    gaussians = start(points, degree=degree)
    assert torch.equal(gaussians.means, points.positions)
    field = RadianceField(FieldConfig(residuals=False))
    anywhere = torch.zeros(3).double()
    torch.testing.assert_close(field.colors(gaussians, anywhere, 3), points.values[RGB])
    torch.testing.assert_close(
        field.temperatures(gaussians, None, anywhere, degree), points.values[THERMAL]
    )
    for modality in MODALITIES:
        torch.testing.assert_close(gaussians.opacity(modality), points.opacities[modality])
    torch.testing.assert_close(gaussians.quats, torch.tensor([1.0, 0, 0, 0]).expand(30, 4))


def test_sizes_are_the_spacing_of_the_points():
    line = torch.zeros(9, 3)
    line[:, 0] = torch.arange(9.0)
    scales = start(points_at(line)).scales
    torch.testing.assert_close(scales[4], torch.full((3,), ((1 + 1 + 4) / 3) ** 0.5))
    torch.testing.assert_close(scales[0], torch.full((3,), ((1 + 4 + 9) / 3) ** 0.5))


def test_a_lonely_distant_point_is_no_larger_than_its_limit():
    points = cloud(30)
    points.positions[-1] = 1e3
    points.max_scales[-1] = 20.0
    scales = start(points).scales
    torch.testing.assert_close(scales[-1], torch.full((3,), 20.0))
    assert (scales[:-1] < 20).all()


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_or_coincident_points_have_some_size(count):
    point = torch.ones(count, 3)
    gaussians = start(points_at(point))
    torch.testing.assert_close(gaussians.scales, torch.full((count, 3), SMALLEST_DISTANCE))
    assert all(tensor.isfinite().all() for tensor in gaussians.tensors().values())


def test_too_many_points_give_a_random_subset():
    points = cloud(50)
    gaussians = start(points, cap=20)
    rows = [int((points.positions == mean).all(dim=1).nonzero()) for mean in gaussians.means]
    assert len(set(rows)) == 20
    assert rows == sorted(rows)
    assert torch.equal(start(points, cap=20).means, gaussians.means)
    whole = start(points)
    for name in ("sh_dc.rgb", "sh_dc.thermal", "opacity_logit.rgb"):
        assert torch.equal(gaussians.tensors()[name], whole.tensors()[name][rows])
    assert not torch.equal(start(points, cap=20, seed=1).means, gaussians.means)


def test_each_method_has_its_columns():
    gaussians = start(cloud(5), shares_opacity=True, degree=3, residuals=False)
    assert set(gaussians.opacity_logits) == {RGB}
    assert gaussians.sh_rest[THERMAL].shape == (5, 15, 1)
    assert gaussians.embedding.shape == (5, 0)
    gaussians = start(cloud(5))
    assert set(gaussians.opacity_logits) == {RGB, THERMAL}
    assert gaussians.sh_rest[THERMAL].shape == (5, 0, 1)
    assert gaussians.embedding.shape == (5, 24)


def test_parameters_share_no_memory():
    points = cloud(5)
    gaussians = start(points)
    gaussians.opacity_logits[RGB].zero_()
    gaussians.means.zero_()
    assert (gaussians.opacity_logits[THERMAL] != 0).all()
    assert (points.positions != 0).any()


def test_a_temperature_that_is_not_known_is_the_middle_of_the_range():
    points = cloud(3)
    points.values[THERMAL][1] = torch.nan
    assert start(points).sh_dc[THERMAL][:, 0, 0].tolist()[1] == 0.0


NIR = Modality("nir", 1)


@pytest.mark.parametrize(
    ("captured", "shares", "expected"),
    [
        ((RGB, THERMAL), False, (RGB, THERMAL)),
        ((RGB, THERMAL), True, (RGB,)),
        ((RGB,), False, (RGB,)),
        ((THERMAL,), False, (RGB,)),
        ((RGB, NIR), False, (RGB, NIR)),
        ((THERMAL, NIR), False, (THERMAL, NIR)),
        ((THERMAL, NIR), True, (RGB,)),
        ((NIR,), False, (RGB,)),
        ((RGB, THERMAL, NIR), False, (RGB, THERMAL, NIR)),
    ],
)
def test_modalities_with_photos_have_opacities_of_their_own(captured, shares, expected):
    assert blended_apart(captured, shares) == expected
