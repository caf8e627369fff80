from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

import mrgs.render
from mrgs.errors import KernelWarning
from mrgs.field import FieldConfig, RadianceField, nearest_neighbours
from mrgs.rasterizer import Geometry, contract, median_depth, rasterize, reference
from mrgs.rasterizer.contract import Dilation
from mrgs.render import Model, bake_temperature_residuals, render, shared_passes
from mrgs.scene import (
    RGB,
    THERMAL,
    Camera,
    Gaussians,
    Modality,
    Rendering,
    TemperatureRange,
)
from mrgs.scene.radiometry import BandRadiance
from mrgs.system.operation import checking
from tests.helpers.gaussians import NEAR_INFRARED, random_gaussians

ALL = (RGB, THERMAL, NEAR_INFRARED)


def make_camera(
    angle: float = 0.0, distance: float = 4.0, width: int = 33, height: int = 26
) -> Camera:
    """Looks at the origin from a circle about the y axis; narrow, so that it sees a part of the
    Gaussians."""
    K = torch.tensor([[40.0, 0, 17], [0, 42, 12], [0, 0, 1]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 0] = viewmat[2, 2] = math.cos(angle)
    viewmat[0, 2], viewmat[2, 0] = math.sin(angle), -math.sin(angle)
    viewmat[2, 3] = distance
    return Camera(K, viewmat, width, height)


def make_model(
    dtype: torch.dtype = torch.float32, count: int = 60, bands: int = 0, **field_options
) -> Model:
    gaussians = random_gaussians(count, bands=bands, modalities=ALL)
    gaussians.log_scales = 0.3 * gaussians.log_scales - 1.5
    for modality in (RGB, NEAR_INFRARED):
        gaussians.sh_rest[modality] *= 0.2
    torch.manual_seed(0)
    field = RadianceField(FieldConfig(**field_options))
    field.set_frame(gaussians.means)
    gaussians.embedding = field.initial_embedding(gaussians.means)
    k = field.config.neighbours_k
    neighbours = nearest_neighbours(gaussians.means, k) if k else None
    gaussians = Gaussians.from_tensors(
        {name: tensor.to(dtype).requires_grad_() for name, tensor in gaussians.tensors().items()},
        ALL,
    )
    return Model(gaussians, field.to(dtype), neighbours, sh_degree=2, dilation=Dilation())


def images_of(rendering: Rendering) -> dict[str, torch.Tensor]:
    return {
        f"{modality} {name}": image
        for modality, blend in rendering.items()
        for name, image in blend._asdict().items()
    }


def gradients(model: Model, *renderings: Rendering) -> dict[str, torch.Tensor]:
    """Of a fixed random weighting of all images."""
    total = torch.zeros((), dtype=model.gaussians.means.dtype)
    for rendering in renderings:
        for name, image in images_of(rendering).items():
            weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(len(name)))
            total = total + (weights * image).sum()
    tensors = {
        name: tensor for name, tensor in model.gaussians.tensors().items() if tensor.numel() > 0
    }
    tensors |= dict(model.field.named_parameters())
    found = torch.autograd.grad(total, list(tensors.values()), allow_unused=True)
    return {
        name: gradient
        for name, gradient in zip(tensors, found, strict=True)
        if gradient is not None
    }


def assert_same(found: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> None:
    assert set(found) == set(expected)
    for name, tensor in expected.items():
        error = (found[name] - tensor).norm() / tensor.norm().clamp_min(1e-12)
        assert error < 1e-4, f"{name}: {error}"


def both(camera: Camera) -> dict[Modality, Camera]:
    return {RGB: camera, THERMAL: camera}


def test_a_fused_pass_is_two_passes():
    model, camera = make_model(), make_camera()
    fused, passes = render(model, {RGB: camera, THERMAL: make_camera()})
    rgb, thermal = render(model, {RGB: camera}), render(model, {THERMAL: camera})
    assert (len(passes), len(rgb[1]), len(thermal[1])) == (1, 1, 1)
    assert_same(images_of(fused), {**images_of(rgb[0]), **images_of(thermal[0])})
    assert_same(gradients(model, fused), gradients(model, rgb[0], thermal[0]))
    torch.testing.assert_close(passes[0].radii, torch.maximum(rgb[1][0].radii, thermal[1][0].radii))


def test_the_offset_collects_the_screen_space_gradient_of_both_modalities():
    model, camera = make_model(), make_camera()
    runs = [render(model, cameras) for cameras in (both(camera), {RGB: camera}, {THERMAL: camera})]
    grads = []
    for rendering, passes in runs:
        torch.stack(
            [image.square().sum() for image in images_of(rendering).values()]
        ).sum().backward()
        grads.append(passes[0].offset.grad)
    torch.testing.assert_close(grads[0], grads[1] + grads[2], rtol=1e-3, atol=1e-3)
    assert (grads[0][passes[0].radii > 0] != 0).any()


def test_two_cameras_are_two_passes():
    model, here, there = make_model(), make_camera(0.0), make_camera(0.2, width=20, height=16)
    rendering, passes = render(model, {RGB: here, THERMAL: there})
    assert [points.size for points in passes] == [(33, 26), (20, 16)]
    assert rendering[RGB].image.shape == (26, 33, 3)
    assert rendering[THERMAL].image.shape == (16, 20, 1)
    rgb, thermal = render(model, {RGB: here})[0], render(model, {THERMAL: there})[0]
    assert_same(images_of(rendering), {**images_of(rgb), **images_of(thermal)})


HERE, THERE, ELSEWHERE = make_camera(0.0), make_camera(0.2), make_camera(0.4)


@pytest.mark.parametrize(
    ("cameras", "passes"),
    [
        ({}, []),
        ({THERMAL: HERE}, [(HERE, [THERMAL])]),
        ({RGB: HERE, THERMAL: make_camera(0.0)}, [(HERE, [RGB, THERMAL])]),
        ({THERMAL: HERE, RGB: HERE}, [(HERE, [THERMAL, RGB])]),
        ({RGB: HERE, THERMAL: THERE}, [(HERE, [RGB]), (THERE, [THERMAL])]),
        # The rasterizer takes one modality of each number of channels.
        (dict.fromkeys(ALL, HERE), [(HERE, [RGB, THERMAL]), (HERE, [NEAR_INFRARED])]),
        (
            {RGB: HERE, THERMAL: THERE, NEAR_INFRARED: HERE},
            [(HERE, [RGB, NEAR_INFRARED]), (THERE, [THERMAL])],
        ),
        (
            {RGB: HERE, THERMAL: THERE, NEAR_INFRARED: THERE},
            [(HERE, [RGB]), (THERE, [THERMAL]), (THERE, [NEAR_INFRARED])],
        ),
        (
            {RGB: HERE, THERMAL: THERE, NEAR_INFRARED: ELSEWHERE},
            [(HERE, [RGB]), (THERE, [THERMAL]), (ELSEWHERE, [NEAR_INFRARED])],
        ),
    ],
)
def test_coinciding_cameras_share_a_pass(cameras, passes):
    assert shared_passes(cameras) == passes


@pytest.mark.parametrize(
    "angles", [(0.0, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.2, 0.2), (0.0, 0.2, 0.4)]
)
def test_three_modalities_are_three_renderings(angles):
    model = make_model()
    cameras = {modality: make_camera(angle) for modality, angle in zip(ALL, angles, strict=True)}
    rendering, passes = render(model, cameras)
    assert list(rendering) == list(ALL)
    assert len(passes) == len(shared_passes(cameras))
    alone = [render(model, {modality: camera})[0] for modality, camera in cameras.items()]
    expected = {name: image for each in alone for name, image in images_of(each).items()}
    assert_same(images_of(rendering), expected)
    assert_same(gradients(model, rendering), gradients(model, *alone))


def test_images_come_in_the_order_of_their_cameras():
    cameras = {NEAR_INFRARED: HERE, THERMAL: HERE, RGB: HERE}
    assert list(render(make_model(), cameras)[0]) == list(cameras)


def test_a_modality_without_a_camera_is_left_out():
    model, camera = make_model(), make_camera()
    for modality in ALL:
        assert list(render(model, {modality: camera})[0]) == [modality]
    rendering, passes = render(model, {})
    assert (dict(rendering), passes) == ({}, [])


def test_temperatures_are_blended_as_radiance():
    """By the definition: the radiance of each splat, by its weight, read as a temperature."""
    radiance = BandRadiance.of(TemperatureRange(-40.0, 120.0))
    model, camera = make_model(torch.float64), make_camera()
    linear = render(model, both(camera))[0]
    found = render(replace(model, radiance=radiance), both(camera))[0]
    of_splats = radiance.of_value(model.values(THERMAL, camera.position))
    blended = sum(
        weights_of(model, camera, splat) * received for splat, received in enumerate(of_splats)
    )
    torch.testing.assert_close(found[THERMAL].image, radiance.to_value(blended))
    assert (found[THERMAL].image - linear[THERMAL].image).max() > 1e-3
    torch.testing.assert_close(found[RGB], linear[RGB])
    torch.testing.assert_close(found[THERMAL].alpha, linear[THERMAL].alpha)


def weights_of(model: Model, camera: Camera, splat: int) -> torch.Tensor:
    """What the pixels show if one splat has the value 1, and all others have 0."""
    zeros = torch.zeros(len(model.gaussians), 1, dtype=torch.float64)
    own = replace(model, temperature_residuals=zeros).values(THERMAL, camera.position)
    alone = torch.eye(len(own), dtype=torch.float64)[:, [splat]]
    shown = render(replace(model, temperature_residuals=alone - own), {THERMAL: camera})[0]
    return shown[THERMAL].image


def test_double_precision_is_kept():
    camera = make_camera()
    single, double = make_model(), make_model(torch.float64)
    expected = images_of(render(double, both(camera))[0])

    found = images_of(render(single, both(camera))[0])

    assert all(image.dtype == torch.float64 for image in expected.values())
    for name, image in expected.items():
        assert (found[name] - image).abs().mean() < 1e-4 * image.abs().mean(), name


@pytest.mark.parametrize("options", [{}, {"fourier": False}])
@pytest.mark.parametrize(("angle", "distance"), [(0.0, 4.0), (1.0, 1.5), (2.0, 0.0), (3.0, -1.0)])
def test_gaussians_out_of_view_need_no_values(angle, distance, options, monkeypatch):
    """They get none unless nearly all are in view."""
    model, camera = make_model(**options), make_camera(angle, distance)
    monkeypatch.setattr(mrgs.render, "ALL_ROWS_FROM", -1.0)  # every row is evaluated
    everything = render(model, both(camera))[0]
    monkeypatch.undo()
    in_view = render(model, both(camera))[0]
    assert_same(images_of(in_view), images_of(everything))
    expected = gradients(model, everything)
    assert_same(gradients(model, in_view), expected)
    assert (expected["sh_dc.rgb"].flatten(1) == 0).all(dim=1).any()  # some are out of view


@pytest.mark.compares_kernels
def test_a_falloff_that_is_edited_to_reach_farther_is_drawn_whole(monkeypatch):
    def flatter(pixels, means2d, covs2d):
        return original(pixels, means2d, covs2d) ** 0.1

    model, camera = make_model(), make_camera()
    original = reference.falloffs
    monkeypatch.setattr(reference, "falloffs", flatter)
    monkeypatch.setattr(rasterize, "rejected", set())
    with pytest.warns(KernelWarning), checking():
        render(model, both(camera))
    found = render(model, both(camera))[0]
    monkeypatch.setattr(mrgs.render, "rows_in_view", lambda *arguments: None)
    assert_same(images_of(found), images_of(render(model, both(camera))[0]))
    assert (found[RGB].alpha > 0.5).all()


def test_a_model_is_drawn_with_its_own_dilation():
    model, camera = make_model(), make_camera()
    images = {}
    for dilation in (contract.DILATION_PX2, 0.05):
        model.dilation = Dilation(dilation)
        images[dilation] = render(model, both(camera))[0]
    published, own = images.values()
    for modality in published:
        assert own[modality].alpha.sum() < 0.99 * published[modality].alpha.sum()


def test_an_empty_pixel_is_black_and_as_cold_as_the_range_begins():
    model = make_model()
    rendering = render(model, dict.fromkeys(ALL, make_camera(distance=-50.0)))[0]
    assert all((image == 0).all() for image in images_of(rendering).values())


@pytest.mark.parametrize("bands", [0, 15])
def test_the_degree_of_the_harmonics_counts_for_temperatures_that_have_them(bands):
    model, camera = make_model(bands=bands), make_camera()
    plain = render(model, both(camera), {RGB: 0, THERMAL: 0})[0]
    full = render(model, both(camera))[0]
    assert not torch.allclose(plain[RGB].image, full[RGB].image)
    assert torch.equal(plain[THERMAL].image, full[THERMAL].image) == (bands == 0)


@pytest.mark.parametrize("angle", [0.0, 0.4])
@pytest.mark.parametrize("modality", [THERMAL, NEAR_INFRARED])
def test_a_modality_can_be_rendered_without_its_harmonics(modality, angle):
    model = make_model(bands=15)
    cameras = {RGB: make_camera(0.0), modality: make_camera(angle)}
    found = render(model, cameras, {modality: 0})[0]
    full = render(model, cameras)[0]
    model.gaussians.sh_rest[modality] = model.gaussians.sh_rest[modality][:, :0]
    torch.testing.assert_close(found[modality].image, render(model, cameras)[0][modality].image)
    assert not torch.allclose(found[modality].image, full[modality].image, atol=1e-2)
    assert torch.equal(found[RGB].image, full[RGB].image)


@pytest.mark.parametrize("bands", [0, 15])
def test_known_residuals_give_the_same_images_without_the_thermal_branch(bands):
    model = make_model(bands=bands)
    cameras = [make_camera(angle) for angle in (0.0, 1.0)]
    with torch.no_grad():
        expected = [images_of(render(model, both(camera))[0]) for camera in cameras]
        baked = bake_temperature_residuals(model)
        model.field.temperature_output.bias.add_(1)  # shows wherever the branch is evaluated
        found = [images_of(render(baked, both(camera))[0]) for camera in cameras]
    for images, baked_images in zip(expected, found, strict=True):
        for name, image in images.items():
            torch.testing.assert_close(baked_images[name], image, atol=2e-6, rtol=0)


def test_a_model_without_residuals_has_none_to_know():
    assert (
        bake_temperature_residuals(make_model(bands=15, residuals=False)).temperature_residuals
        is None
    )


def test_where_nothing_is_there_is_no_surface():
    nothing = render(make_model(), both(make_camera(distance=-50.0)))[0]
    for modality in nothing:
        assert nothing.surface_depth(modality, max_step=0.1).isnan().all()
    with_median = render(make_model(), both(make_camera(distance=-50.0)), with_median_depth=True)[0]
    assert with_median.surface_depth(THERMAL).isnan().all()


@pytest.mark.parametrize("dilation", [0.3, 0.1])
def test_the_surface_is_the_median_depth_where_that_is_asked_for(dilation):
    model, cameras = make_model(), both(make_camera())
    model.dilation = Dilation(dilation)
    blended, found = (render(model, cameras, with_median_depth=asked)[0] for asked in (False, True))
    gaussians = model.gaussians
    camera = cameras[THERMAL]
    projection = model.dilation.projection(camera, gaussians.means.device)
    median = median_depth(Geometry.of(gaussians), gaussians.opacity(THERMAL), projection)
    covered = found[THERMAL].alpha >= 0.5
    assert covered.any()
    assert torch.equal(found.surface_depth(THERMAL)[covered], median[covered])
    assert not torch.equal(found.surface_depth(THERMAL), blended.surface_depth(THERMAL))
    assert torch.equal(found[THERMAL].depth, blended[THERMAL].depth)
