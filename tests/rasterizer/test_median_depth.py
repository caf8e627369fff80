"""The median depth: closed forms, and the CPU kernel against the plain definition."""

from __future__ import annotations

import math

import pytest
import torch

from mrgs.kernels.rasterize.cpu import rasterize as cpu
from mrgs.rasterizer import Geometry, Projection, reference
from tests.helpers.rasterizers import random_scene

K = torch.tensor([[20.0, 0, 10.5], [0, 20.0, 7.5], [0, 0, 1]], dtype=torch.float64)
CAMERA = Projection(torch.eye(4, dtype=torch.float64), K, 21, 15)
CENTRE = (7, 10)


def on_axis(depths, opacities):
    """Round Gaussians on the optical axis, so that α is the opacity at the principal point."""
    count = len(depths)
    means = torch.zeros(count, 3, dtype=torch.float64)
    means[:, 2] = torch.tensor(depths)
    quats = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(count, 4)
    geometry = Geometry(means, quats, torch.full_like(means, 0.5))
    return geometry, torch.tensor(opacities).double()


def median_at_centre(depths, opacities):
    return reference.median_depth(*on_axis(depths, opacities), CAMERA)[CENTRE].item()


def test_one_surface():
    assert median_at_centre([4.0], [0.9]) == pytest.approx(4.0)


def test_fog_before_a_wall_moves_the_mean_and_not_the_median():
    assert median_at_centre([1.0, 2.0, 6.0, 6.1], [0.2, 0.2, 0.99, 0.99]) == pytest.approx(6.0)


def test_little_that_shines_through_does_not_move_it():
    assert median_at_centre([2.0, 50.0], [0.8, 0.99]) == pytest.approx(2.0)


def test_what_comes_after_one_half_does_not_count():
    near = median_at_centre([2.0, 3.0], [0.6, 0.9])
    assert near == median_at_centre([2.0, 30.0], [0.6, 0.9]) == pytest.approx(2.0)


def test_a_surface_of_two_gaussians_lies_between_them():
    """T falls from 1 to 0.55 to 0.25: a quarter of [0.6, 0.4] is the first's."""
    assert median_at_centre([4.0, 4.2], [0.45, 0.3 / 0.55]) == pytest.approx(4.15)


def oblique_disc(kind):
    """A wide thin disc through (0, 0, 4), turned by 0.9 rad about the vertical axis."""
    quats = torch.tensor([[math.cos(0.45), 0, math.sin(0.45), 0]])
    scales = torch.tensor([[1.5, 1.5, 1e-4]])
    means = torch.tensor([[0.0, 0, 4.0]])
    geometry = Geometry(means.to(kind), quats.to(kind), scales.to(kind))
    return geometry, torch.tensor([0.95]).to(kind)


@pytest.mark.parametrize("place", [(7, 10), (7, 11), (8, 9), (6, 11)])
def test_an_oblique_disc_is_a_plane(place):
    """Its centre's depth would be off by up to 6 %. (A dilation makes it a little flatter.)"""
    thin = CAMERA._replace(dilation_px2=1e-3)
    depth = reference.median_depth(*oblique_disc(torch.float64), thin)[place].item()
    x = (place[1] + 0.5 - 10.5) / 20
    # The plane: (z − 4) cos 0.9 + x z sin 0.9 = 0, with the normal's x as R_y(0.9) turns it.
    exact = 4 * math.cos(0.9) / (math.cos(0.9) + x * math.sin(0.9))
    assert depth == pytest.approx(exact, rel=1e-5)


def test_a_disc_seen_at_a_grazing_angle_ends_somewhere():
    """Its plane meets some rays at infinity, or behind the camera."""
    disc, opacities = oblique_disc(torch.float64)
    quats = torch.tensor([[math.cos(-0.7), 0, math.sin(-0.7), 0]]).double()
    scales = torch.tensor([[4.0, 4.0, 0.1]]).double()
    disc = disc._replace(quats=quats, scales=scales)
    depth = reference.median_depth(disc, 0 * opacities + 0.99, CAMERA)
    known = depth[~depth.isnan()]
    assert 0 < known.min().item() < 2.0
    assert known.max().item() == pytest.approx(16.0)


@pytest.mark.parametrize("opacities", [[0.49], [0.3, 0.25]])
def test_no_surface_where_more_than_half_passes(opacities):
    depths = [2.0, 3.0][: len(opacities)]
    assert math.isnan(median_at_centre(depths, opacities))


def test_no_gaussian_in_front_of_the_camera():
    medians = reference.median_depth(*on_axis([-1.0], [0.9]), CAMERA)
    assert medians.shape == (15, 21)
    assert medians.isnan().all()


def test_chunks_do_not_change_it():
    """In a tall image, with the Gaussians where the second chunk of pixels begins."""
    scene = on_axis([2.0, 3.0, 4.0], [0.3, 0.4, 0.9])
    width, height = CAMERA.width, CAMERA.height
    top = reference.CHUNK_ELEMENTS // 3 // width - height // 2
    lowered = K + torch.tensor([[0.0, 0, 0], [0, 0, top], [0, 0, 0]])
    tall = reference.median_depth(*scene, CAMERA._replace(K=lowered, height=top + 2 * height))
    whole = reference.median_depth(*scene, CAMERA)
    assert whole[6:9].isfinite().any(dim=1).all()
    torch.testing.assert_close(tall[top : top + height], whole, equal_nan=True)


@pytest.mark.parametrize("seed", range(30))
@pytest.mark.parametrize("modality", ["rgb", "thermal"])
def test_kernel_against_the_plain_definition(seed, modality):
    """Away from pixels where T ends near one half, or an α near 1/255."""
    scene = random_scene(seed, n=5 + 20 * (seed % 5), dtype=torch.float32)
    name, precise = f"{modality}.opacities", scene.to(torch.float64)
    kernel = cpu.median_depth(scene.geometry, scene.tensors[name], scene.projection).double()
    exact = reference.median_depth(precise.geometry, precise.tensors[name], precise.projection)
    near = scene.to(torch.float64).pixels_near_a_threshold()
    differs = kernel.isnan() != exact.isnan()
    assert not (differs & ~near).float().mean() > 0.002
    both = ~kernel.isnan() & ~exact.isnan() & ~near
    wrong = ((kernel - exact).abs() > 1e-3 * exact)[both]
    assert wrong.sum() <= 0.002 * max(1, len(wrong))


def test_kernel_refuses_other_sizes_and_types():
    scene = on_axis([2.0], [0.5])
    with pytest.raises(ValueError, match="float32"):
        cpu.median_depth(*scene, CAMERA)
