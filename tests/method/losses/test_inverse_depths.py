"""The sums of inverse depths against what they are sums of, ray by ray and Gaussian by Gaussian."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from mrgs.method.losses.distortion import (
    InverseDepths,
    inverse_depths,
    ray_directions,
    surface_planes,
)
from mrgs.rasterizer import Geometry, Projection, reference
from mrgs.rasterizer.contract import STEEPEST_TANGENT
from mrgs.scene import Camera
from tests.helpers.gaussians import random_gaussians

WIDTH, HEIGHT = 12, 9
DILATION_PX2 = 0.1
K = torch.tensor([[11.0, 0.0, 6.5], [0.0, 10.0, 4.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def camera(distance: float = 4.0) -> Tensor:
    """World to camera, turned and off the middle."""
    viewmat = torch.eye(4, dtype=torch.float64)
    c, s = math.cos(0.3), math.sin(0.3)
    viewmat[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    viewmat[:3, 3] = torch.tensor([0.2, -0.1, distance])
    return viewmat


def inputs(count: int = 30) -> list[Tensor]:
    """Means, quats, scales, opacities; some are behind the camera."""
    g = random_gaussians(count)
    tensors = (g.means, g.quats, g.log_scales.exp(), g.opacity(next(iter(g.opacity_logits))))
    return [tensor.detach().double().requires_grad_() for tensor in tensors]


def sums_of(tensors: list[Tensor], viewmat: Tensor) -> InverseDepths:
    return inverse_depths(Geometry(*tensors[:3]), tensors[3], projection(viewmat))


def projection(viewmat: Tensor, dilation_px2: float = DILATION_PX2) -> Projection:
    return Projection(viewmat, K, WIDTH, HEIGHT, dilation_px2)


def ray_by_ray(means, quats, scales, opacities, viewmat) -> tuple[Tensor, Tensor, Tensor]:
    """Σ w, Σ w ρ and Σ w ρ², from the weights of every pixel and Gaussian."""
    geometry = Geometry(means, quats, scales)
    splats = reference.project(geometry, projection(viewmat))
    pixels = reference.pixel_centres(WIDTH, HEIGHT, means)
    falloff = reference.falloffs(pixels, splats.means2d, splats.covs2d)
    alpha = reference.alphas(opacities[splats.indices], falloff)
    alpha = torch.where(reference.unfinished(alpha), alpha, 0.0)
    weights = alpha * reference.transmittances(alpha)[:, :-1]
    planes = surface_planes(geometry, projection(viewmat))[splats.indices]
    x, y = (plane.flatten() for plane in ray_directions(K, WIDTH, HEIGHT))
    nearness = torch.stack([x, y, torch.ones_like(x)], dim=1) @ planes.T
    sums = (weights, weights * nearness, weights * nearness**2)
    return tuple(each.sum(dim=1).unflatten(0, (HEIGHT, WIDTH)) for each in sums)


def test_the_sums_and_their_gradients_are_those_of_each_ray():
    tensors, viewmat = inputs(), camera()
    found = sums_of(tensors, viewmat)
    expected = ray_by_ray(*tensors, viewmat)
    scale = torch.linspace(-1, 2, WIDTH * HEIGHT, dtype=torch.float64).view(HEIGHT, WIDTH)
    assert (found.weight > 0.5).any()
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other)
        gradients = torch.autograd.grad((scale * one).sum(), tensors, retain_graph=True)
        wanted = torch.autograd.grad((scale * other).sum(), tensors, retain_graph=True)
        torch.testing.assert_close(gradients, wanted)


def test_the_kernels_find_the_spread_of_the_depths():
    tensors, viewmat = inputs(), camera()
    exact = sums_of(tensors, viewmat)
    single = [tensor.detach().float().requires_grad_() for tensor in tensors]
    found = sums_of(single, viewmat)
    for one, other in zip(found, exact, strict=True):
        torch.testing.assert_close(one, other.float(), rtol=1e-5, atol=1e-6)
    variance = found.weight * found.squares - found.sum**2
    expected = exact.weight * exact.squares - exact.sum**2
    torch.testing.assert_close(variance, expected.float(), rtol=1e-3, atol=1e-6)
    (variance.sum() + found.sum.sum()).backward()
    assert all(tensor.grad.isfinite().all() for tensor in single)


def test_rays_pass_through_the_centres_of_the_pixels():
    x, y = ray_directions(K, WIDTH, HEIGHT)
    at_depth_1 = Camera(K, torch.eye(4), WIDTH, HEIGHT).unproject_image(torch.ones_like(x))
    torch.testing.assert_close(torch.stack([x, y, torch.ones_like(x)], dim=2), at_depth_1)


def disc(tilt: float) -> list[Tensor]:
    """A flat Gaussian before a camera that looks along z, turned about the y axis."""
    quat = [math.cos(tilt / 2), 0.0, math.sin(tilt / 2), 0.0]
    rows = ([[0.3, -0.2, 4.0]], [quat], [[0.5, 0.5, 1e-4]])
    return [torch.tensor(row, dtype=torch.float64) for row in rows]


def plane_of(mean: Tensor, quat: Tensor, scale: Tensor) -> Tensor:
    ahead = projection(torch.eye(4, dtype=torch.float64), 1e-6)
    return surface_planes(Geometry(mean, quat, scale), ahead)[0]


@pytest.mark.parametrize("tilt", [0.0, 0.6, -1.2])
def test_rays_meet_a_disc_in_its_plane(tilt):
    mean, quat, scale = disc(tilt)
    plane = plane_of(mean, quat, scale)
    normal = torch.tensor([math.sin(tilt), 0.0, math.cos(tilt)], dtype=torch.float64)
    torch.testing.assert_close(plane, normal / (normal @ mean[0]), rtol=1e-4, atol=1e-6)


def test_a_plane_through_the_camera_is_as_steep_as_planes_may_be():
    mean, _, scale = disc(0.0)
    edge_on = math.pi / 2 + math.atan2(mean[0, 0].item(), mean[0, 2].item()) - 1e-5
    quat = disc(edge_on)[1]
    plane = plane_of(mean, quat, scale)
    assert abs(plane[0] * mean[0, 2]) == STEEPEST_TANGENT
    torch.testing.assert_close(plane @ (mean[0] / mean[0, 2]), 1 / mean[0, 2])


def test_gaussians_behind_the_camera_and_in_its_plane_leave_gradients_finite():
    tensors = inputs()
    with torch.no_grad():
        tensors[0][:2] = torch.tensor([[0.0, 0.0, -3.0], [0.0, 0.0, 0.0]])
    viewmat = torch.eye(4, dtype=torch.float64)
    sum(each.sum() for each in sums_of(tensors, viewmat)).backward()
    assert all(tensor.grad.isfinite().all() for tensor in tensors)
