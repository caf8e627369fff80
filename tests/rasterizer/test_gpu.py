"""The Triton kernels against the oracle (float64) on the same numbers.

Without a CUDA device they are interpreted, which takes milliseconds for every step of a program:
the scenes are tiny. What a GPU alone can do, larger scenes, is marked ``gpu``.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

import mrgs.rasterizer
from mrgs.errors import MrgsError
from mrgs.rasterizer import Geometry, Layer, Projection, reference
from mrgs.rasterizer.contract import DILATION_PX2, LEAST_DILATION_PX2
from mrgs.system import operation
from tests.helpers.rasterizers import (
    ANY_CHANNELS,
    assert_any_channels,
    assert_gradients_of_needles,
    assert_same_bits,
    assert_shows_the_background,
    assert_small,
    compare_with_oracle,
    images_of,
    random_scene,
    render_and_differentiate,
    wide_and_flat,
)


@pytest.fixture
def rasterize(gpu_device: str) -> Callable:
    """The kernels; tensors go to their device and images come back from it, as the comparison
    expects."""
    from mrgs.kernels.rasterize.gpu import rasterize as gpu

    def on_device(geometry, layers, projection, means2d_offset=None):
        layers = [Layer(*(tensor.to(gpu_device) for tensor in layer)) for layer in layers]
        geometry = Geometry(*(tensor.to(gpu_device) for tensor in geometry))
        offset = None if means2d_offset is None else means2d_offset.to(gpu_device)
        raster = gpu.rasterize(geometry, layers, projection, offset)
        blends = tuple(type(blend)(*(image.cpu() for image in blend)) for blend in raster.blends)
        return type(raster)(blends, raster.radii.cpu())

    return on_device


# --- against the oracle


@pytest.mark.parametrize(("seed", "n"), [(0, 3), (1, 12), (2, 25), (3, 18)])
def test_images_and_gradients_of_random_scenes(rasterize, seed, n):
    scene = random_scene(seed, n, dtype=torch.float32)
    assert_small(compare_with_oracle(rasterize, scene, seed=seed))


@pytest.mark.parametrize("modalities", [("rgb",), ("thermal",), ("thermal", "rgb")])
def test_one_layer_and_layers_in_the_other_order(rasterize, modalities):
    scene = random_scene(11, 15, 20, 12, dtype=torch.float32)
    assert_small(compare_with_oracle(rasterize, scene, modalities=modalities))


@pytest.mark.parametrize(
    ("width", "height", "n"), [(1, 1, 4), (1, 20, 10), (33, 3, 10), (32, 16, 10)]
)
def test_other_image_sizes(rasterize, width, height, n):
    assert_small(compare_with_oracle(rasterize, random_scene(1, n, width, height, torch.float32)))


def test_pixels_that_are_finished_early(rasterize):
    """A wall of opaque Gaussians before all others: the walks stop long before the lists do."""
    scene = random_scene(4, 30, 20, 12, dtype=torch.float32)
    tensors = dict(scene.tensors)
    means = reference.to_camera(tensors["means"], scene.viewmat)
    wall = {"means": [0.0, 0.0, 0.5], "quats": [1.0, 0.0, 0.0, 0.0], "scales": [2.0, 1.5, 0.1]}
    for name, values in wall.items():
        others = means if name == "means" else tensors[name]
        tensors[name] = torch.cat([torch.tensor([values]).repeat(5, 1), others[5:]])
    for modality in ("rgb", "thermal"):
        tensors[f"{modality}.opacities"] = torch.cat(
            [torch.full((5,), 0.95), tensors[f"{modality}.opacities"][5:]]
        )
    scene = replace(scene, tensors=tensors, viewmat=torch.eye(4))
    assert scene.render(rasterize).blends[0].alpha.min() > 0.9999
    assert_small(compare_with_oracle(rasterize, scene))


def test_wide_opaque_gaussians_meet_the_clamp_of_alpha(rasterize):
    """Where α = 0.999 the opacity and the exponent get no gradient; in the other random scenes this
    is rare.

    The bound is wider, for 1 / (1 − α) multiplies float32's rounding by a thousand; a gradient that
    ignores the clamp misses it.
    """
    scene = random_scene(0, 12, 20, 12, dtype=torch.float32)
    opaque = {"rgb.opacities": torch.full((12,), 0.99999)}
    errors = compare_with_oracle(
        rasterize, wide_and_flat(replace(scene, tensors=scene.tensors | opaque))
    )
    assert_small(errors, gradient_error_max=1e-3)


def test_equal_depths_are_blended_in_the_order_of_their_index(rasterize):
    scene = random_scene(4, 20, 20, 12, dtype=torch.float32)
    camera_z = torch.tensor([[0.0, 0.0, 2.0]])
    wall = torch.cat(
        [torch.rand(20, 2, generator=torch.Generator().manual_seed(0)) - 0.5, torch.zeros(20, 1)],
        dim=1,
    )
    scene = replace(scene, viewmat=torch.eye(4), tensors=scene.tensors | {"means": wall + camera_z})
    assert_small(compare_with_oracle(rasterize, scene))


def test_needles_keep_their_alpha(rasterize) -> None:
    """Slanting Gaussians, thousands of pixels long and a pixel wide: their quadratic form cancels
    in float32."""
    alphas = []
    for function, dtype in ((rasterize, torch.float32), (reference.rasterize, torch.float64)):
        means = torch.tensor([[0.0, 0.0, 1.0], [0.01, 0.0, 1.2], [0.0, 0.02, 1.4]], dtype=dtype)
        quats = torch.tensor([[math.cos(0.32), 0.0, 0.0, math.sin(0.32)]], dtype=dtype).repeat(3, 1)
        scales = torch.tensor(
            [[30.0, 1e-4, 1e-4], [1.0, 1e-4, 1e-4], [5.0, 1e-4, 1e-4]], dtype=dtype
        )
        layer = Layer(
            *(torch.tensor(v, dtype=dtype) for v in ([0.9, 0.5, 0.4], [[0.5] * 3] * 3, [0.0] * 3))
        )
        K = torch.tensor([[600.0, 0, 25], [0, 600, 20], [0, 0, 1]], dtype=dtype)
        projection = Projection(torch.eye(4, dtype=dtype), K, 50, 40)
        raster = function(Geometry(means, quats, scales), [layer], projection)
        alphas.append(raster.blends[0].alpha.double())
    assert alphas[1].max() > 0.8
    assert (
        alphas[0] - alphas[1]
    ).abs().max() < 3e-5  # coordinates of 50 pixels have an error of 4e-6


@pytest.mark.parametrize("dilation_px2", [DILATION_PX2, LEAST_DILATION_PX2])
def test_gradients_of_needles(rasterize, dilation_px2: float) -> None:
    assert_gradients_of_needles(rasterize, dilation_px2)


# --- nothing to see


@pytest.mark.parametrize("n", [0, 30])
def test_an_empty_view_shows_the_background(rasterize, n):
    scene = random_scene(0, n, 20, 12, dtype=torch.float32)
    assert_shows_the_background(rasterize, scene)


@pytest.mark.parametrize("size", [3e38, float("inf"), float("nan")])
def test_a_gaussian_without_a_usable_size_is_left_out(rasterize, size: float) -> None:
    means, quats = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[0.9, 0.1, 0.3, 0.2]])
    layer = Layer(torch.tensor([0.5]), torch.ones(1, 3), torch.zeros(3))
    K = torch.tensor([[60.0, 0, 5], [0, 60, 4], [0, 0, 1]])
    with np.errstate(all="ignore"):  # of the interpreter's numpy
        geometry = Geometry(means, quats, torch.full((1, 3), size))
        raster = rasterize(geometry, [layer], Projection(torch.eye(4), K, 10, 8))
    assert raster.radii.tolist() == [0.0]
    assert raster.blends[0].alpha.max() == 0


# --- the same bits, and what callers hand over


def test_repeated_calls_give_the_same_bits_and_views_can_be_in_flight(rasterize):
    first, second = (
        random_scene(seed, 6, 20, 12, torch.float32).with_leaves() for seed in (12, 13)
    )
    expected = (
        render_and_differentiate(rasterize, first),
        render_and_differentiate(rasterize, second),
    )
    rasters = [scene.render(rasterize) for scene in (first, second)]
    for raster in rasters:
        sum(image.square().sum() for image in images_of(raster)).backward()
    for scene, raster, result in zip((first, second), rasters, expected, strict=True):
        outputs = [*images_of(raster), raster.radii]
        assert_same_bits(
            (outputs, {name: tensor.grad for name, tensor in scene.tensors.items()}), result
        )


def test_non_contiguous_inputs_and_cotangents(rasterize):
    scene = random_scene(14, 10, 20, 12, torch.float32)
    strided = replace(
        scene,
        tensors={
            name: torch.stack([t, t - 1], dim=-1)[..., 0] for name, t in scene.tensors.items()
        },
        viewmat=scene.viewmat.T.contiguous().T,
        K=scene.K.T.contiguous().T,
    )
    assert not strided.tensors["means"].is_contiguous()
    for tensor in strided.tensors.values():
        tensor.requires_grad_()
    raster = strided.render(rasterize)
    sum(image.transpose(0, 1).sum() for image in images_of(raster)).backward()
    grads = {name: tensor.grad for name, tensor in strided.tensors.items()}
    dense = render_and_differentiate(
        rasterize, scene, lambda images: sum(image.sum() for image in images)
    )
    assert_same_bits(([*images_of(raster), raster.radii], grads), dense)


def test_a_loss_on_one_image_only(rasterize):
    scene = random_scene(16, 10, 20, 12, torch.float32)
    _, grads = render_and_differentiate(rasterize, scene, lambda images: images[4].square().sum())
    assert grads["means"].any()
    assert not any(gradient.any() for name, gradient in grads.items() if name.startswith("rgb"))


def test_no_offset_is_an_offset_of_zero_and_the_camera_may_be_of_float64(rasterize):
    scene = random_scene(6, 10, 20, 12, torch.float32)
    zero = replace(scene, tensors=scene.tensors | {"means2d_offset": torch.zeros(10, 2)})
    none = replace(
        scene, tensors=scene.tensors | {"means2d_offset": None}, viewmat=scene.viewmat.double()
    )
    for image, image_of_none in zip(
        images_of(zero.render(rasterize)), images_of(none.render(rasterize)), strict=True
    ):
        assert torch.equal(image, image_of_none)


def test_many_tiles_are_numbered_by_wider_integers(rasterize, monkeypatch):
    from mrgs.kernels.rasterize.gpu.rasterize import rasterize as function

    scene = random_scene(7, 10, 20, 12, torch.float32)
    expected = render_and_differentiate(rasterize, scene)
    monkeypatch.setattr(inspect.getmodule(function), "_MOST_SHORT_TILES", 0)
    assert_same_bits(render_and_differentiate(rasterize, scene), expected)


def test_too_many_pairs_are_refused(gpu_device):
    from mrgs.kernels.rasterize.gpu.rasterize import rasterize as function

    each = torch.full((2,), 2**31 - 1, dtype=torch.int32, device=gpu_device)
    listed = {"distances": torch.ones(2, device=gpu_device), "tiles": 4, "pair_counts": each}
    with pytest.raises(MrgsError, match="4,294,967,294 tiles"):
        inspect.getmodule(function)._list(listed)


def test_too_many_gaussians_are_refused(gpu_device):
    from mrgs.kernels.rasterize.gpu.rasterize import rasterize as function

    def many(*columns: int) -> torch.Tensor:  # which take no memory
        return torch.zeros(1, device=gpu_device).expand(2**28, *columns)

    layer = Layer(many(), many(3), torch.zeros(3, device=gpu_device))
    projection = Projection(torch.eye(4), torch.eye(3), 8, 8)
    with pytest.raises(MrgsError, match="268,435,456 Gaussians"):
        function(Geometry(many(3), many(4), many(3)), [layer], projection)


def test_tensors_of_other_sizes_or_types_are_refused(rasterize) -> None:
    geometry = Geometry(torch.zeros(4, 3), torch.ones(4, 4), torch.ones(4, 3))
    layer = Layer(torch.ones(4), torch.ones(4, 3), torch.zeros(3))
    projection = Projection(torch.eye(4), torch.eye(3), 8, 8)
    with pytest.raises(ValueError, match=r"quats must be float32 \[4, 4\] .*\[1, 4\]"):
        rasterize(geometry._replace(quats=torch.ones(1, 4)), [layer], projection)
    with pytest.raises(ValueError, match=r"scales must be float32 .* not float64"):
        rasterize(geometry._replace(scales=geometry.scales.double()), [layer], projection)


@pytest.mark.parametrize("channels", ANY_CHANNELS[:2])
def test_layers_of_any_number_of_channels(rasterize, channels) -> None:
    assert_any_channels(rasterize, channels)


def test_an_image_changed_in_place_before_the_backward_is_noticed(gpu_device) -> None:
    from mrgs.kernels.rasterize.gpu.rasterize import rasterize

    means = torch.tensor([[0.0, 0.0, 1.0]], device=gpu_device, requires_grad=True)
    quats, scales = torch.ones(1, 4, device=gpu_device), torch.full((1, 3), 0.1, device=gpu_device)
    layer = Layer(
        *(
            tensor.to(gpu_device)
            for tensor in (torch.tensor([0.5]), torch.ones(1, 3), torch.zeros(3))
        )
    )
    K = torch.tensor([[60.0, 0, 5], [0, 60, 4], [0, 0, 1]])
    projection = Projection(torch.eye(4), K, 10, 8)
    raster = rasterize(Geometry(means, quats, scales), [layer], projection)
    raster.blends[0].image.mul_(2)
    with pytest.raises(RuntimeError, match="inplace operation"):
        raster.blends[0].image.sum().backward()


def test_what_the_kernels_take_is_handed_to_them(gpu_device, monkeypatch) -> None:
    called, imported = [], operation._imported

    def noting(*arguments):
        called.append(arguments)
        return "raster"

    name = "mrgs.kernels.rasterize.gpu.rasterize.rasterize"
    monkeypatch.setattr(
        operation, "_imported", lambda each: noting if each == name else imported(each)
    )
    scene = random_scene(0, 3, dtype=torch.float32)
    scene = replace(
        scene, tensors={name: tensor.to(gpu_device) for name, tensor in scene.tensors.items()}
    )
    assert scene.render(mrgs.rasterizer.rasterize) == "raster"
    scene = replace(
        scene, tensors={name: tensor.double() for name, tensor in scene.tensors.items()}
    )
    scene.render(mrgs.rasterizer.rasterize)
    assert len(called) == 1


# --- on a device, in sizes that matter


@pytest.mark.gpu
@pytest.mark.parametrize("modalities", [("rgb", "thermal"), ("rgb",), ("thermal",)])
def test_crowded_scenes(rasterize, modalities):
    """More pixels and Gaussians: a coordinate of 300 has an error of 3e-5 px in float32."""
    scene = random_scene(1, 2000, 300, 200, torch.float32)
    errors = compare_with_oracle(rasterize, scene, modalities=modalities)
    for name, error in errors.items():
        assert error < (1e-3 if name.startswith("grad ") else 1e-4), (name, errors)


@pytest.mark.gpu
@pytest.mark.parametrize("seed", range(20))
def test_more_random_scenes(rasterize, seed):
    assert_small(
        compare_with_oracle(rasterize, random_scene(seed, 60, dtype=torch.float32), seed=seed)
    )


@pytest.mark.gpu
def test_many_gaussians_give_the_same_bits_on_every_run(rasterize):
    scene = random_scene(8, 50_000, 1280, 720, torch.float32)
    scene = replace(scene, tensors=scene.tensors | {"scales": 0.05 * scene.tensors["scales"]})
    assert_same_bits(
        render_and_differentiate(rasterize, scene), render_and_differentiate(rasterize, scene)
    )
