"""L_dist: what counts as one surface, and what a training is moved by."""

from __future__ import annotations

import math
from collections.abc import Mapping

import pytest
import torch
from torch import Tensor

from mrgs.method.config import make_config
from mrgs.method.losses.distortion import (
    LARGE_SPREAD,
    LEAST_SPREAD,
    PIXEL_SIZE,
    Distortion,
    InverseDepths,
    distortion_loss,
    inverse_depths,
)
from mrgs.method.losses.term import LossContext, SceneScale
from mrgs.method.losses.terms import configured_terms
from mrgs.rasterizer.contract import Dilation, Geometry, Projection
from mrgs.scene import RGB, THERMAL, Camera, Gaussians, Modality, Rendering
from tests.helpers.gaussians import random_gaussians
from tests.helpers.views import not_rendered, small_camera


def one_pixel(weights: list[float], depths: list[float]) -> InverseDepths:
    w, nearness = torch.tensor(weights), 1 / torch.tensor(depths)
    return InverseDepths(*((w * nearness**k).sum().view(1, 1) for k in range(3)))


def test_two_surfaces_in_a_pixel_count_by_their_weights_and_relative_distance():
    found = distortion_loss(one_pixel([0.3, 0.7], [2.0, 2.5]))
    mean = 0.3 / 2.0 + 0.7 / 2.5
    spread = math.sqrt(0.3 * 0.7) * (1 / 2.0 - 1 / 2.5) / mean
    spread = math.hypot(spread, LEAST_SPREAD)
    assert found.item() == pytest.approx(spread / (1 + spread / LARGE_SPREAD), rel=1e-5)
    twice_as_far = distortion_loss(one_pixel([0.3, 0.7], [4.0, 5.0]))
    torch.testing.assert_close(found, twice_as_far)


def test_what_lies_at_one_depth_or_nowhere_is_thin():
    assert distortion_loss(one_pixel([0.2, 0.2, 0.6], [3.0] * 3)).item() < 1.5 * LEAST_SPREAD
    assert distortion_loss(one_pixel([0.0], [3.0])).item() == pytest.approx(LEAST_SPREAD, rel=0.02)


def wall(tilt: float, thickness: float) -> list[Tensor]:
    """Geometry and opacities of half-transparent discs on a wall before the camera that
    is turned about the y axis, in two layers."""
    steps = torch.linspace(-5, 5, 31, dtype=torch.float64)
    x, y, z = torch.cartesian_prod(steps, steps, torch.tensor([0.0, thickness]).double()).T
    c, s = math.cos(tilt), math.sin(tilt)
    means = torch.stack([c * x + s * z, y, 5 - s * x + c * z], dim=1)
    quats = torch.tensor([math.cos(tilt / 2), 0.0, math.sin(tilt / 2), 0.0]).double()
    scales = torch.tensor([0.3, 0.3, 1e-3], dtype=torch.float64)
    count = len(means)
    opacities = torch.full((count,), 0.5, dtype=torch.float64)
    return Geometry(means, quats.expand(count, 4), scales.expand(count, 3)), opacities


@pytest.mark.parametrize("tilt", [0.0, 0.6])
def test_a_wall_costs_nothing_seen_obliquely_and_a_slab_does(tilt):
    camera = small_camera()
    K, viewmat, _ = camera.tensors(torch.device("cpu"))

    def loss(thickness: float) -> float:
        projection = Projection(viewmat, K, 8, 6, 1e-3)
        depths = inverse_depths(*wall(tilt, thickness), projection)
        assert depths.weight.min() > 0.8
        return distortion_loss(depths).item()

    assert loss(0.0) < 2 * LEAST_SPREAD
    assert loss(0.2) > 5 * LEAST_SPREAD


def context(cameras: Mapping[Modality, Camera], gaussians: Gaussians) -> LossContext:
    nothing, scale = Rendering({}), SceneScale(3.0, None)
    return LossContext(nothing, nothing, {}, cameras, gaussians, Dilation(), scale, not_rendered)


@pytest.mark.parametrize(
    ("cameras", "finest"),
    [
        ({RGB: small_camera(0.0), THERMAL: small_camera(0.2)}, THERMAL),
        ({RGB: small_camera(0.0), THERMAL: small_camera(0.2).resized(4, 3)}, RGB),
        ({RGB: small_camera(0.0)}, RGB),
    ],
    ids=["equal", "thermal coarser", "no thermal photo"],
)
def test_it_looks_through_the_camera_with_the_finest_pixels(cameras, finest):
    gaussians = random_gaussians(20)
    gaussians.means[:, 2] += 4
    moved = (gaussians.means, gaussians.quats, gaussians.log_scales)
    parameters = [p.requires_grad_() for p in (*moved, gaussians.opacity_logits[finest])]
    value = Distortion(0.1, 0).value(context(cameras, gaussians))
    camera = cameras[finest].resized(8 // PIXEL_SIZE, 6 // PIXEL_SIZE)
    projection = Dilation().projection(camera, gaussians.means.device)
    depths = inverse_depths(Geometry.of(gaussians), gaussians.opacity(finest), projection)
    assert value == distortion_loss(depths)
    for gradient in torch.autograd.grad(value, parameters):
        assert gradient.isfinite().all()
        assert gradient.any()


def test_it_begins_after_a_share_of_the_steps_and_counts_for_those_between():
    terms = {term.name: term for term in configured_terms(make_config("mrgs-plus", "fast"))}
    term = terms["distortion"]
    due = [step for step in range(1, 1501) if term.is_due(step)]
    assert (due[0], due[-1]) == (456, 1496)
    assert sum(term.weight(step) for step in due) == pytest.approx(0.1 * 1048)
    assert "distortion" not in {term.name for term in configured_terms(make_config("mrgs"))}
