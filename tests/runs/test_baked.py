from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch

from mrgs.field import FieldConfig, RadianceField, nearest_neighbours
from mrgs.rasterizer.contract import Dilation
from mrgs.render import Model, render
from mrgs.runs.baked import bake
from mrgs.scene import RGB, THERMAL, Camera, Gaussians, Modality, TemperatureRange
from tests.helpers.gaussians import NEAR_INFRARED

COUNT = 80


def make_camera(angle: float) -> Camera:
    """Looks at the origin from a circle about the y axis."""
    K = torch.tensor([[40.0, 0, 17], [0, 42, 12], [0, 0, 1]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 0] = viewmat[2, 2] = math.cos(angle)
    viewmat[0, 2], viewmat[2, 0] = math.sin(angle), -math.sin(angle)
    viewmat[2, 3] = 4.0
    return Camera(K, viewmat, 33, 26)


CAMERAS = [make_camera(angle) for angle in torch.linspace(-0.6, 0.6, 24).tolist()]


def make_model(
    sh_degree: int = 3,
    bands: int = 0,
    modalities: Sequence[Modality] = (RGB, THERMAL),
    **field_options,
) -> Model:
    torch.manual_seed(0)
    config = FieldConfig(**field_options)
    field = RadianceField(config)
    means = 0.7 * torch.randn(COUNT, 3)
    field.set_frame(means)
    gaussians = Gaussians(
        means=means,
        quats=torch.randn(COUNT, 4),
        log_scales=0.3 * torch.randn(COUNT, 3) - 1.5,
        opacity_logits={each: torch.randn(COUNT, 1) for each in modalities},
        sh_dc={each: torch.rand(COUNT, 1, each.channels) for each in modalities},
        sh_rest={
            each: 0.05 * torch.randn(COUNT, bands if each == THERMAL else 15, each.channels)
            for each in modalities
        },
        embedding=field.initial_embedding(means),
    )
    neighbours = nearest_neighbours(means, config.neighbours_k) if config.neighbours_k else None
    return Model(gaussians, field, neighbours, sh_degree, dilation=Dilation(0.1))


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return -10 * float(torch.log10((a - b).square().mean()))


@pytest.mark.parametrize("sh_degree", [1, 3])
def test_a_baked_model_looks_like_the_trained_one(sh_degree):
    model = make_model(sh_degree, color_scale=0.2, temperature_scale=0.2)
    baked = bake(model, CAMERAS, None)
    unseen = make_camera(0.33)
    with torch.no_grad():
        expected = render(model, dict.fromkeys((RGB, THERMAL), unseen))[0]
    found = baked.render(unseen)
    torch.testing.assert_close(found[THERMAL].image, expected[THERMAL].image, atol=2e-6, rtol=0)
    torch.testing.assert_close(found[RGB].depth, expected[RGB].depth)
    assert psnr(found[RGB].image, expected[RGB].image) > 50


def test_the_colour_residual_counts():
    model = make_model(color_scale=0.2, temperature_scale=0.2)
    plain = bake(make_model(color_scale=0.0, temperature_scale=0.0), CAMERAS, None)
    with torch.no_grad():
        expected = render(model, {RGB: CAMERAS[5]})[0][RGB].image
    baked = bake(model, CAMERAS, None)
    assert (
        psnr(baked.render(CAMERAS[5])[RGB].image, expected)
        > psnr(plain.render(CAMERAS[5])[RGB].image, expected) + 10
    )


def test_spherical_harmonics_alone_are_kept_as_they_are():
    model = make_model(residuals=False)
    baked = bake(model, CAMERAS, None)
    for found, expected in (
        (baked.sh_dc, model.gaussians.sh_dc),
        (baked.sh_rest, model.gaussians.sh_rest),
    ):
        assert found[RGB].data_ptr() == expected[RGB].data_ptr()
        assert torch.equal(found[RGB], expected[RGB])


@pytest.mark.parametrize("residuals", [True, False])
def test_what_of_the_temperatures_depends_on_the_view_is_left_out(residuals):
    model = make_model(bands=15, residuals=residuals)
    rest = {**model.gaussians.sh_rest, THERMAL: torch.zeros(COUNT, 0, 1)}
    flat = replace(model, gaussians=replace(model.gaussians, sh_rest=rest))
    torch.testing.assert_close(
        bake(model, CAMERAS, None).temperatures, bake(flat, CAMERAS, None).temperatures
    )


def test_temperatures_are_celsius_where_the_scale_is_known():
    model = make_model()
    baked = bake(model, CAMERAS, TemperatureRange(10.0, 30.0))
    assert baked.temperature == TemperatureRange(10.0, 30.0)
    assert bake(model, CAMERAS, None).temperature is None


@pytest.mark.parametrize("sh_degree", [1, 3])
def test_a_third_modality_is_kept_as_it_is_rendered(sh_degree):
    model = make_model(
        sh_degree, modalities=(RGB, THERMAL, NEAR_INFRARED), color_scale=0.2, temperature_scale=0.2
    )
    baked = bake(model, CAMERAS, None)
    assert baked.modalities == (RGB, THERMAL, NEAR_INFRARED)
    unseen = dict.fromkeys(baked.modalities, make_camera(0.33))
    with torch.no_grad():
        expected = render(model, unseen)[0]
    found = baked.render(make_camera(0.33))
    for one, other in zip(found[NEAR_INFRARED], expected[NEAR_INFRARED], strict=True):
        torch.testing.assert_close(one, other, atol=2e-6, rtol=1e-5)


def test_only_the_asked_modalities_are_rendered():
    baked = bake(make_model(), CAMERAS, None)
    alone = baked.render({THERMAL: CAMERAS[3]})
    assert list(alone) == [THERMAL]
    torch.testing.assert_close(alone[THERMAL].image, baked.render(CAMERAS[3])[THERMAL].image)


def test_the_callers_default_device_does_not_matter():
    baked = bake(make_model(), CAMERAS, None)
    usual = baked.render(CAMERAS[3])
    with torch.device("meta"):
        again = baked.render(CAMERAS[3])
    for modality, blend in usual.items():
        assert torch.equal(again[modality].image, blend.image)


def test_a_subset_has_the_rows_in_their_order():
    baked = bake(make_model(), CAMERAS, TemperatureRange(10.0, 30.0))
    rows = torch.tensor([7, 3, 40])
    subset = baked.subset(rows)
    assert len(subset) == 3
    assert set(subset.tensors()) == {
        "means", "quats", "scales", "opacity.rgb", "opacity.thermal", "sh_dc.rgb", "sh_rest.rgb",
        "temperatures",
    }  # fmt: skip
    for name, tensor in baked.tensors().items():
        assert torch.equal(subset.tensors()[name], tensor[rows]), name
    assert subset.temperature == baked.temperature


def test_a_camera_is_needed():
    with pytest.raises(ValueError, match="without a camera"):
        bake(make_model(), [], None)


def test_the_surface_of_a_rendering_is_not_what_shines_through_it():
    """A wall at z = 0 that lets a twentieth of the light through, and a sky far behind it."""
    baked = bake(make_model(), CAMERAS, None)
    walls = baked.map_tensors(lambda tensor: tensor[:2].clone())
    walls.means[:] = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 400.0]])
    walls.quats[:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    walls.scales[:] = torch.tensor([[5.0, 5.0, 0.01], [500.0, 500.0, 1.0]])
    for opacity in walls.opacities.values():
        opacity[:] = torch.tensor([0.95, 0.99])
    rendering = walls.render(make_camera(0.0), RGB)
    assert float(rendering.surface_depth(RGB, 0.5)[13, 16]) == pytest.approx(4.0, rel=1e-3)
    assert float(rendering[RGB].depth[13, 16]) > 20


def test_a_model_for_another_device_is_copied_there_to_be_rendered():
    host, elsewhere = (bake(make_model(), CAMERAS, None, torch.device(d)) for d in ("cpu", "meta"))
    assert {each.device.type for each in elsewhere.tensors().values()} == {"cpu"}
    assert {each.device.type for each in elsewhere._rendered.tensors().values()} == {"meta"}
    assert elsewhere.subset(torch.arange(3)).device.type == "meta"
    assert host._rendered.means is host.means
