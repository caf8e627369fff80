"""The median depth: closed forms, and the CPU kernel against the plain definition."""

from __future__ import annotations

import math

import pytest
import torch

from mrgs.kernels.rasterize import cpu
from mrgs.rasterizer import reference
from tests.helpers.rasterizers import random_scene

K = torch.tensor([[20.0, 0, 10.5], [0, 20.0, 7.5], [0, 0, 1]], dtype=torch.float64)
CAMERA = (torch.eye(4, dtype=torch.float64), K, 21, 15)
CENTRE = (7, 10)


def on_axis(depths, opacities):
    """Round Gaussians on the optical axis, so that α is the opacity at the principal point."""
    count = len(depths)
    means = torch.zeros(count, 3, dtype=torch.float64)
    means[:, 2] = torch.tensor(depths)
    quats = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(count, 4)
    return means, quats, torch.full_like(means, 0.5), torch.tensor(opacities).double()


def median_at_centre(depths, opacities):
    return reference.median_depth(*on_axis(depths, opacities), *CAMERA)[CENTRE].item()


def test_one_surface():
    assert median_at_centre([4.0], [0.9]) == pytest.approx(4.0)


def test_fog_before_a_wall_moves_the_mean_and_not_the_median():
    assert median_at_centre([1.0, 2.0, 6.0, 6.1], [0.2, 0.2, 0.99, 0.99]) == pytest.approx(6.0)


def test_little_that_shines_through_does_not_move_it():
    assert median_at_centre([2.0, 50.0], [0.8, 0.99]) == pytest.approx(2.0)


def test_what_comes_after_one_half_does_not_count():
    near = median_at_centre([2.0, 3.0], [0.6, 0.9])
    assert near == median_at_centre([2.0, 30.0], [0.6, 0.9]) == pytest.approx(2.0)


@pytest.mark.parametrize("opacities", [[0.49], [0.3, 0.25]])
def test_no_surface_where_more_than_half_passes(opacities):
    depths = [2.0, 3.0][: len(opacities)]
    assert math.isnan(median_at_centre(depths, opacities))


def test_no_gaussian_in_front_of_the_camera():
    medians = reference.median_depth(*on_axis([-1.0], [0.9]), *CAMERA)
    assert medians.shape == (15, 21)
    assert medians.isnan().all()


def test_chunks_do_not_change_it(monkeypatch):
    scene = on_axis([2.0, 3.0, 4.0], [0.3, 0.4, 0.9])
    whole = reference.median_depth(*scene, *CAMERA)
    monkeypatch.setattr(reference, "CHUNK_ELEMENTS", 10)
    torch.testing.assert_close(reference.median_depth(*scene, *CAMERA), whole, equal_nan=True)


@pytest.mark.parametrize("seed", range(30))
@pytest.mark.parametrize("modality", ["rgb", "thermal"])
def test_kernel_against_the_plain_definition(seed, modality):
    """Away from pixels where T ends near one half, or an α near 1/255."""
    scene = random_scene(seed, n=5 + 20 * (seed % 5), dtype=torch.float32)
    t = scene.tensors
    arguments = (
        t["means"], t["quats"], t["scales"], t[f"{modality}.opacities"],
        scene.viewmat, scene.K, scene.width, scene.height,
    )  # fmt: skip
    kernel = cpu.median_depth(*arguments).double()
    exact = reference.median_depth(
        *(value.double() if isinstance(value, torch.Tensor) else value for value in arguments)
    )
    near = scene.to(torch.float64).pixels_near_a_threshold()
    differs = kernel.isnan() != exact.isnan()
    assert not (differs & ~near).float().mean() > 0.002
    both = ~kernel.isnan() & ~exact.isnan() & ~near
    wrong = ((kernel - exact).abs() > 1e-3 * exact)[both]
    assert wrong.sum() <= 0.002 * max(1, len(wrong))


def test_kernel_refuses_other_sizes_and_types():
    scene = on_axis([2.0], [0.5])
    with pytest.raises(ValueError, match="float32"):
        cpu.median_depth(*scene, *CAMERA)
