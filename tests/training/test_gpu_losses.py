"""The losses' Triton kernels against plain torch in float64; tiny, because they are interpreted
where no GPU is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from mrgs.method.camera_model import point_spread
from mrgs.method.camera_model.image_model import ImageModel, ImageModelConfig
from mrgs.method.config import make_config
from mrgs.method.losses import photometric as losses
from mrgs.method.losses import radiation
from mrgs.method.losses.photometric import total_loss
from mrgs.method.losses.smoothness import similarity_of, total_variation
from mrgs.method.losses.term import LossContext, SceneScale
from mrgs.method.losses.terms import configured_terms, term_values
from mrgs.rasterizer.contract import Dilation
from mrgs.scene import RGB, THERMAL, Blend, Camera, Pixels, Rendering, TemperatureRange
from mrgs.scene.capture import Capture, Viewpoint
from mrgs.system.cuda_graph import sync_debug_mode
from mrgs.training.state import learned_layers
from tests.helpers.gaussians import random_gaussians
from tests.helpers.views import not_rendered


def image(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def assert_same(
    loss: Callable[..., torch.Tensor],
    plain: Callable[..., torch.Tensor],
    inputs: list[torch.Tensor],
    device: str,
    tolerance: float = 3e-6,
) -> None:
    """A loss in float32 on the device agrees with a definition in float64, and so do the gradients
    by the inputs."""
    exact = [tensor.double().requires_grad_() for tensor in inputs]
    found = [tensor.to(device, torch.float32).requires_grad_() for tensor in inputs]
    expected, value = plain(*exact), loss(*found)
    assert value.dtype == torch.float32
    assert value.device.type == device
    torch.testing.assert_close(value.cpu(), expected.float(), rtol=2e-6, atol=1e-7)
    scale = torch.linspace(1, 2, expected.numel(), dtype=torch.float64).view_as(expected)
    gradients = torch.autograd.grad((scale.to(value) * value).sum(), found)
    wanted = torch.autograd.grad((scale * expected).sum(), exact)
    for gradient, exact_gradient in zip(gradients, wanted, strict=True):
        assert (gradient.cpu() - exact_gradient).norm() <= tolerance * exact_gradient.norm()


@pytest.mark.parametrize(
    ("shape", "masked", "dssim", "width"),
    [
        ((18, 12, 3), False, 0.2, 0.0),  # two strips of rows
        ((3, 140, 1), True, 0.2, 0.0),  # two blocks of values
        ((3, 140, 1), True, 0.2, 0.3),
        ((3, 2, 2), True, 0.0, 0.0),
    ],
)
def test_the_photometric_loss_is_that_of_plain_torch(gpu_device, shape, masked, dssim, width):
    target = image(*shape, seed=1)
    valid = image(*shape[:2], seed=2) > 0.3 if masked else None
    on_device = (
        target.to(gpu_device, torch.float32),
        None if valid is None else valid.to(gpu_device),
    )
    assert_same(
        lambda render: losses.photometric_loss(render, *on_device, dssim, width),
        lambda render: losses.photometric_loss.plain(render, target, valid, dssim, width),
        [image(*shape)],
        gpu_device,
    )


@pytest.mark.parametrize("masked", [False, True])
def test_the_radiation_loss_is_that_of_plain_torch(gpu_device, masked):
    valid = image(4, 9, seed=3) > 0.3 if masked else None
    on_device = None if valid is None else valid.to(gpu_device)
    assert_same(
        lambda *maps: radiation.boltzmann_loss(*maps, on_device),
        lambda *maps: radiation.boltzmann_loss.plain(*maps, valid),
        [image(4, 9), image(4, 9, seed=1), image(4, 9, seed=2)],
        gpu_device,
    )


@pytest.mark.parametrize("shape", [(1, 1, 2), (1, 6, 2), (6, 1, 2), (13, 15, 3)])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("weighted", [False, True])
def test_the_variation_is_that_of_plain_torch(gpu_device, shape, masked, weighted):
    valid = image(*shape, seed=1)[..., 0] > 0.3 if masked else None
    on_device = None if valid is None else valid.to(gpu_device)
    weights = similarity_of(image(*shape, seed=2), 0.3) if weighted else (None, None)
    there = [None if each is None else each.to(gpu_device, torch.float32) for each in weights]
    assert_same(
        lambda values: total_variation(values, on_device, *there),
        lambda values: total_variation.plain(values, valid, *weights),
        [image(*shape)],
        gpu_device,
    )


@pytest.mark.parametrize(
    ("shape", "sigma_px"), [((7, 9), 1.1), ((2, 30), 0.3), ((1, 4), 2.5), ((20, 17), 0.8)]
)
def test_the_blur_is_that_of_plain_torch(gpu_device, shape, sigma_px):
    assert_same(
        point_spread.blur,
        point_spread.blur.plain,
        [image(*shape), torch.tensor(sigma_px)],
        gpu_device,
        tolerance=6e-6,  # the gradient by σ is a sum of both signs
    )


def test_a_value_that_is_not_finite_is_not_hidden(gpu_device):
    spoilt = image(2, 5, 1).to(gpu_device, torch.float32)
    spoilt[1, 2, 0] = float("nan")
    assert total_variation(spoilt).isnan()
    assert losses.photometric_loss(spoilt, torch.zeros_like(spoilt), None, 0.2).isnan()


@pytest.mark.slow
@pytest.mark.parametrize("masked", [False, True])
def test_no_loss_makes_the_host_wait(masked):
    """On a device whose tensors have no values: what asks for one fails, as on a GPU it would make
    the host wait. That the kernels ask for none is tested with whole steps."""
    config = make_config("mrgs", "fast")
    parts = ImageModelConfig(point_spread=True, thermal_gain=True)
    size, viewpoints = (30, 20), (Viewpoint((0, 0, 0), (0, 0, 1)),) * 4
    image_model = ImageModel(parts, Capture(viewpoints, 2.0, has_celsius=False)).to("meta")

    def plane(*channels: int) -> torch.Tensor:
        return torch.empty(size[1], size[0], *channels, device="meta")

    def photo(channels: int) -> Pixels:
        return Pixels(plane(channels), plane() > 0 if masked else None)

    modalities = (RGB, THERMAL)
    blends = {
        each: Blend(*(plane(*c).requires_grad_() for c in ((each.channels,), (), ())))
        for each in modalities
    }
    rendering = Rendering(blends)
    observed = image_model(rendering, torch.ones(1, dtype=torch.int64, device="meta"))
    camera = Camera(torch.eye(3, dtype=torch.float64), torch.eye(4, dtype=torch.float64), *size)
    changed = replace(config, loss=replace(config.loss, opaque=0.1, smooth_depth=1.0))
    context = LossContext(
        rendering,
        observed,
        {each: photo(each.channels) for each in modalities},
        dict.fromkeys(modalities, camera),
        random_gaussians(1),
        Dilation(),
        SceneScale(2.0, TemperatureRange(10.0, 30.0)),
        not_rendered,
    )
    terms = configured_terms(changed)
    for layers in learned_layers(terms).values():
        layers.to("meta")
    values = term_values(terms, context)
    assert set(values) == {"rgb", "thermal", "smooth", "opaque", "boltzmann"}
    weights = {term.name: term.weight(700) for term in terms}
    total_loss(values, weights).backward()
    learned = [p for layers in learned_layers(terms).values() for p in layers.parameters()]
    assert learned
    assert all(parameter.grad is not None for parameter in learned)
    without_gradient = [
        (modality, name)
        for modality, blend in blends.items()
        for name, tensor in blend._asdict().items()
        if tensor.grad is None
    ]
    assert without_gradient == [(RGB, "alpha")]
    assert all(parameter.grad is not None for parameter in image_model.parameters())


def test_asking_a_tensor_without_values_fails():
    with pytest.raises(RuntimeError):
        torch.empty(3, device="meta").sum().item()


@pytest.mark.gpu
def test_large_images_and_the_same_bits_again():
    render, target = image(480, 641, 3), image(480, 641, 3, seed=1)
    valid = image(480, 641, seed=2) > 0.1
    on_device = (target.to("cuda", torch.float32), valid.to("cuda"))

    def loss(render: torch.Tensor) -> torch.Tensor:
        return losses.photometric_loss(render, *on_device, 0.2)

    assert_same(
        loss,
        lambda render: losses.photometric_loss.plain(render, target, valid, 0.2),
        [render],
        "cuda",
    )
    found = render.to("cuda", torch.float32).requires_grad_()
    with sync_debug_mode("error"):
        gradients = [torch.autograd.grad(loss(found), found)[0] for _ in range(2)]
    assert torch.equal(*gradients)
