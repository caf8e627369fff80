from __future__ import annotations

import math

import pytest
import torch

import mrgs.render
from mrgs.field import FieldConfig, RadianceField, nearest_neighbours
from mrgs.rasterizer import reference
from mrgs.render import Model, Rendering, bake_temperature_residuals, render, render_view
from mrgs.scene import Camera, Gaussians, Pixels, PosedImage, View


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
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(count, *shape, generator=generator)

    torch.manual_seed(0)
    field = RadianceField(FieldConfig(**field_options))
    means = random(3)
    field.set_frame(means)
    tensors = {
        "means": means,
        "quats": random(4),
        "log_scales": 0.3 * random(3) - 1.5,
        "opacity_rgb_logit": random(1),
        "opacity_thermal_logit": random(1),
        "sh_dc": random(1, 3),
        "sh_rest": 0.2 * random(15, 3),
        "temperature_dc": random(1, 1),
        "temperature_rest": random(bands, 1),
        "embedding": field.initial_embedding(means),
    }
    gaussians = Gaussians(
        **{name: tensor.to(dtype).requires_grad_() for name, tensor in tensors.items()}
    )
    k = field.config.neighbours_k
    return Model(
        gaussians, field.to(dtype), nearest_neighbours(means, k) if k else None, sh_degree=2
    )


def images_of(rendering: Rendering) -> dict[str, torch.Tensor]:
    return {name: image for name, image in rendering._asdict().items() if image is not None}


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


def test_a_fused_pass_is_two_passes():
    model, camera = make_model(), make_camera()
    fused, passes = render(model, camera, make_camera())
    rgb, thermal = render(model, camera, None), render(model, None, camera)
    assert (len(passes), len(rgb[1]), len(thermal[1])) == (1, 1, 1)
    assert_same(images_of(fused), {**images_of(rgb[0]), **images_of(thermal[0])})
    assert_same(gradients(model, fused), gradients(model, rgb[0], thermal[0]))
    torch.testing.assert_close(passes[0].radii, torch.maximum(rgb[1][0].radii, thermal[1][0].radii))


def test_the_offset_collects_the_screen_space_gradient_of_both_modalities():
    model, camera = make_model(), make_camera()
    runs = [render(model, camera, camera), render(model, camera, None), render(model, None, camera)]
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
    rendering, passes = render(model, here, there)
    assert [points.size for points in passes] == [(33, 26), (20, 16)]
    assert rendering.rgb.shape == (26, 33, 3)
    assert rendering.thermal.shape == (16, 20, 1)
    rgb, thermal = render(model, here, None)[0], render(model, None, there)[0]
    assert_same(images_of(rendering), {**images_of(rgb), **images_of(thermal)})


def test_a_modality_without_a_camera_is_left_out():
    model, camera = make_model(), make_camera()
    assert set(images_of(render(model, camera, None)[0])) == {"rgb", "depth_rgb", "alpha_rgb"}
    assert set(images_of(render(model, None, camera)[0])) == {
        "thermal",
        "depth_thermal",
        "alpha_thermal",
    }
    rendering, passes = render(model, None, None)
    assert images_of(rendering) == {}
    assert passes == []


def test_double_precision_goes_through_the_oracle(monkeypatch):
    calls = []

    def oracle(*args):
        calls.append(args[0].dtype)
        return original(*args)

    original = reference.rasterize
    monkeypatch.setattr(reference, "rasterize", oracle)
    camera = make_camera()
    single, double = make_model(), make_model(torch.float64)
    expected = images_of(render(double, camera, camera)[0])
    assert calls == [torch.float64]
    found = images_of(render(single, camera, camera)[0])
    assert calls == [torch.float64]
    assert all(image.dtype == torch.float64 for image in expected.values())
    for name, image in expected.items():
        assert (found[name] - image).abs().mean() < 1e-4 * image.abs().mean(), name


@pytest.mark.parametrize("options", [{}, {"fourier": False}])
@pytest.mark.parametrize(("angle", "distance"), [(0.0, 4.0), (1.0, 1.5), (2.0, 0.0), (3.0, -1.0)])
def test_gaussians_out_of_view_need_no_values(angle, distance, options, monkeypatch):
    model, camera = make_model(**options), make_camera(angle, distance)
    monkeypatch.setattr(mrgs.render, "ALL_ROWS_FROM", -1.0)  # every row is evaluated
    everything = render(model, camera, camera)[0]
    monkeypatch.setattr(mrgs.render, "ALL_ROWS_FROM", 1.0)
    in_view = render(model, camera, camera)[0]
    assert_same(images_of(in_view), images_of(everything))
    expected = gradients(model, everything)
    assert_same(gradients(model, in_view), expected)
    assert (expected["sh_dc"].flatten(1) == 0).all(dim=1).any()  # some are out of view


def test_a_view_is_rendered_without_gradients():
    model, camera = make_model(), make_camera()
    image = PosedImage(camera, lambda: Pixels(torch.zeros(26, 33, 3)))
    rendering = render_view(model, View("a", image, None))
    assert not rendering.rgb.requires_grad
    assert rendering.thermal is None
    assert_same({"rgb": rendering.rgb}, {"rgb": render(model, camera, None)[0].rgb})


def test_an_empty_pixel_is_black_and_as_cold_as_the_range_begins():
    model = make_model()
    rendering = render(model, *[make_camera(distance=-50.0)] * 2)[0]
    assert (rendering.rgb == 0).all()
    assert (rendering.thermal == 0).all()
    assert (rendering.alpha_rgb == 0).all()


@pytest.mark.parametrize("bands", [0, 15])
def test_the_degree_of_the_harmonics_counts_for_temperatures_that_have_them(bands):
    model, camera = make_model(bands=bands), make_camera()
    model.sh_degree = 0
    plain = render(model, camera, camera)[0]
    model.sh_degree = 3
    full = render(model, camera, camera)[0]
    assert not torch.allclose(plain.rgb, full.rgb)
    assert torch.equal(plain.thermal, full.thermal) == (bands == 0)


@pytest.mark.parametrize("thermal_angle", [0.0, 0.4])
def test_temperatures_can_be_rendered_without_their_harmonics(thermal_angle):
    model = make_model(bands=15)
    cameras = make_camera(0.0), make_camera(thermal_angle)
    found = render(model, *cameras, temperature_sh_degree=0)[0]
    full = render(model, *cameras)[0]
    model.gaussians.temperature_rest = model.gaussians.temperature_rest[:, :0]
    torch.testing.assert_close(found.thermal, render(model, *cameras)[0].thermal)
    assert not torch.allclose(found.thermal, full.thermal, atol=1e-2)
    assert torch.equal(found.rgb, full.rgb)


@pytest.mark.parametrize("bands", [0, 15])
def test_known_residuals_give_the_same_images_without_the_thermal_branch(bands, monkeypatch):
    model = make_model(bands=bands)
    cameras = [make_camera(angle) for angle in (0.0, 1.0)]
    with torch.no_grad():
        expected = [images_of(render(model, camera, camera)[0]) for camera in cameras]
        baked = bake_temperature_residuals(model)
        monkeypatch.setattr(
            RadianceField,
            "temperature_residuals",
            lambda *_: pytest.fail("the thermal branch was evaluated"),
        )
        found = [images_of(render(baked, camera, camera)[0]) for camera in cameras]
    for images, baked_images in zip(expected, found, strict=True):
        for name, image in images.items():
            torch.testing.assert_close(baked_images[name], image, atol=2e-6, rtol=0)


def test_a_model_without_residuals_has_none_to_know():
    assert (
        bake_temperature_residuals(make_model(bands=15, residuals=False)).temperature_residuals
        is None
    )


def rendering_of(depths: list[list[float]], alphas: list[list[float]]) -> Rendering:
    """A thermal rendering whose surfaces have these depths."""
    alpha = torch.tensor(alphas)
    return Rendering(depth_thermal=torch.tensor(depths) * alpha, alpha_thermal=alpha)


def test_a_surfaces_depth_is_that_of_the_blend_without_the_background():
    rendering = rendering_of([[2.0, 2.0, 3.0]], [[0.8, 0.5, 0.4]])
    expected = torch.tensor([[2.0, 2.0, torch.nan]])
    torch.testing.assert_close(rendering.surface_depth("thermal"), expected, equal_nan=True)
    expected[0, 1] = torch.nan
    torch.testing.assert_close(
        rendering.surface_depth("thermal", min_alpha=0.6), expected, equal_nan=True
    )


def test_outlines_have_no_depth_where_they_are_not_wanted():
    """A near and a far surface, both slightly slanted, and a hole, which is no outline of what is
    beside it."""
    row = [2.0, 2.01, 2.02, 4.0, 4.02, 4.04, 9.0, 4.1]
    rendering = rendering_of([row] * 3, [[1.0] * 6 + [0.1, 1.0]] * 3)
    found = rendering.surface_depth("thermal", max_step=0.05)
    expected = torch.tensor([row] * 3)
    expected[:, [2, 3, 6]] = torch.nan
    torch.testing.assert_close(found, expected, equal_nan=True)
    assert rendering.surface_depth("thermal").isnan().sum() == 3


def test_where_nothing_is_there_is_no_surface():
    nothing = render(make_model(), *[make_camera(distance=-50.0)] * 2)[0]
    for modality in ("rgb", "thermal"):
        assert nothing.surface_depth(modality, max_step=0.1).isnan().all()
