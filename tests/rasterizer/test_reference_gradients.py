"""The oracle's gradients against finite differences, in float64."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from mrgs.rasterizer import reference
from mrgs.rasterizer.reference import rasterize
from tests.helpers.rasterizers import random_cotangents, random_scene

SEEDS = [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3, 4))]


def smooth_scene(seed):
    """Four large, half transparent Gaussians over a 5 × 4 image of a long lens: far from every
    threshold, at which α and T jump.

    With o in [0.3, 0.7] and axes of 6 to 12 px around the middle of the image, each α lies between
    1/255 and 0.999 in each pixel, and T stays above 0.3⁴ > 1e-4. Steps of 1e-6 then never cross a
    threshold, nor reorder the depths.
    """
    scene = random_scene(seed, n=24, width=5, height=4)
    scene = replace(scene, K=scene.K * scene.K.new_tensor([[4, 1, 1], [1, 4, 1], [1, 1, 1]]))
    keep = [i for i in range(24) if i % 10 and i % 3][
        :4
    ]  # in front of the camera, and not the huge ones
    rng = torch.Generator().manual_seed(seed)
    t = {
        name: values if "background" in name else values[keep]
        for name, values in scene.tensors.items()
    }
    depths = reference.to_camera(t["means"], scene.viewmat)[:, 2:]
    pixels = torch.tensor([2.5, 2.0]) + 2 * torch.rand(4, 2, generator=rng, dtype=torch.float64) - 1
    means_camera = depths * torch.cat(
        [(pixels - scene.K[:2, 2]) / scene.K.diagonal()[:2], torch.ones(4, 1)], dim=1
    )
    t["means"] = (means_camera - scene.viewmat[:3, 3]) @ scene.viewmat[:3, :3]
    t["scales"] = (
        (6 + 6 * torch.rand(4, 3, generator=rng, dtype=torch.float64))
        * depths
        / scene.K.diagonal()[:2].max()
    )
    for modality in ("rgb", "thermal"):
        t[f"{modality}.opacities"] = 0.3 + 0.4 * torch.rand(4, generator=rng, dtype=torch.float64)
    return replace(scene, tensors=t)


@pytest.mark.parametrize("seed", [0, *(pytest.param(1, marks=pytest.mark.slow), *SEEDS[2:])])
def test_gradcheck_of_every_input(seed):
    scene = smooth_scene(seed).with_leaves()

    def images(*tensors):
        raster = replace(scene, tensors=dict(zip(scene.tensors, tensors, strict=True))).render(
            rasterize
        )
        return tuple(image for blend in raster.blends for image in blend)

    alpha = images(*scene.tensors.values())[2]
    assert 0.1 < alpha.min() < alpha.max() < 1 - 1e-4
    assert torch.autograd.gradcheck(
        images, tuple(scene.tensors.values()), eps=1e-6, atol=1e-6, rtol=1e-5
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_gradient_of_a_crowded_scene_against_central_differences(seed):
    """Along random directions in the space of all inputs; pixels near a threshold have no weight in
    the loss."""
    scene = random_scene(seed).with_leaves()
    raster = scene.render(rasterize)
    cotangents = random_cotangents(raster, scene.pixels_near_a_threshold(), seed)
    gradient = scene.gradients(raster, cotangents)
    rng = torch.Generator().manual_seed(seed)
    step = 1e-6  # far under the margins of pixels_near_a_threshold, and no smaller: rounding

    @torch.no_grad()
    def loss(moved):
        images = [image for blend in moved.render(rasterize).blends for image in blend]
        return sum(
            (cotangent * image).sum() for cotangent, image in zip(cotangents, images, strict=True)
        )

    for name, tensor in scene.tensors.items():
        direction = torch.randn(tensor.shape, generator=rng, dtype=torch.float64)
        ahead, behind = (
            loss(replace(scene, tensors=scene.tensors | {name: tensor + sign * step * direction}))
            for sign in (1, -1)
        )
        slope, expected = (
            (ahead - behind).item() / (2 * step),
            (gradient[name] * direction).sum().item(),
        )
        assert slope == pytest.approx(expected, rel=1e-5, abs=1e-5), name
