"""The CPU kernel (float32) against the oracle (float64) on the same numbers.

``python -m tests.rasterizer.test_cpu`` prints the worst errors over the random scenes.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import numba
import pytest
import torch

from mrgs.rasterizer import Geometry, Layer, Projection, reference
from mrgs.rasterizer.contract import DILATION_PX2, LEAST_DILATION_PX2
from mrgs.system.memory import CHUNK_ROWS
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

SCENES = range(100)


@pytest.fixture(scope="module")
def rasterize():
    from mrgs.kernels.rasterize.cpu.rasterize import rasterize

    return rasterize


def scene_of(seed: int):
    """3 to 60 Gaussians, so that the background shows through some scenes and others are opaque
    throughout."""
    return random_scene(seed, n=3 + 57 * (seed % 10) // 9, dtype=torch.float32)


def worst_errors(rasterize: Callable, seeds: Iterable[int] = SCENES):
    """The largest of each of the errors that ``compare_with_oracle`` names, over the scenes."""
    worst: dict[str, float] = {}
    for seed in seeds:
        for name, error in compare_with_oracle(rasterize, scene_of(seed), seed=seed).items():
            worst[name] = max(worst.get(name, 0.0), error)
    return worst


# --- against the oracle


@pytest.mark.parametrize("seed", SCENES)
def test_images_and_gradients_of_random_scenes(rasterize, seed):
    assert_small(worst_errors(rasterize, [seed]))


def test_few_pixels_are_left_out_of_the_comparison():
    left_out = [scene_of(seed).to(torch.float64).pixels_near_a_threshold() for seed in SCENES]
    assert torch.stack(left_out).double().mean() < 0.005


@pytest.mark.parametrize(
    ("width", "height", "n"), [(1, 1, 4), (3, 50, 30), (64, 48, 60), (61, 45, 700)]
)
def test_other_image_sizes_and_a_crowded_scene(rasterize, width, height, n):
    assert_small(compare_with_oracle(rasterize, random_scene(1, n, width, height, torch.float32)))


@pytest.mark.parametrize("modalities", [("rgb",), ("thermal",), ("thermal", "rgb")])
def test_one_layer_and_layers_in_the_other_order(rasterize, modalities):
    scene = random_scene(11, dtype=torch.float32)
    assert_small(compare_with_oracle(rasterize, scene, modalities=modalities))
    both = dict(zip(("rgb", "thermal"), scene.render(rasterize).blends, strict=True))
    for modality, blend in zip(modalities, scene.render(rasterize, modalities).blends, strict=True):
        for image, image_of_both in zip(blend, both[modality], strict=True):
            torch.testing.assert_close(image, image_of_both, rtol=0, atol=1e-6)


def test_what_the_kernel_leaves_out_is_what_the_oracle_leaves_out(rasterize):
    from mrgs.rasterizer import reference

    for seed in SCENES:
        scene = scene_of(seed)
        radii = scene.render(rasterize).radii
        truth = scene.to(torch.float64).render(reference.rasterize).radii
        assert torch.equal(radii > 0, truth > 0), seed
        assert not radii.requires_grad


def test_equal_depths_are_blended_in_the_order_of_their_index(rasterize):
    scene = random_scene(4, dtype=torch.float32)
    camera_z = torch.tensor([[0.0, 0.0, 2.0]])
    wall = torch.cat(
        [torch.rand(60, 2, generator=torch.Generator().manual_seed(0)) - 0.5, torch.zeros(60, 1)],
        dim=1,
    )
    scene = replace(scene, viewmat=torch.eye(4), tensors=scene.tensors | {"means": wall + camera_z})
    assert_small(compare_with_oracle(rasterize, scene))


@pytest.mark.parametrize("seed", range(5))
def test_wide_opaque_gaussians_meet_the_clamp_of_alpha(rasterize, seed):
    """Where α = 0.999 the opacity and the exponent get no gradient; in the other random scenes this
    is rare.

    The bound is wider, for 1 / (1 − α) multiplies float32's rounding by a thousand; a gradient that
    ignores the clamp misses it in every one of these scenes.
    """
    scene = random_scene(seed, n=12, dtype=torch.float32)
    opaque = {"rgb.opacities": torch.full((12,), 0.99999)}
    errors = compare_with_oracle(
        rasterize, wide_and_flat(replace(scene, tensors=scene.tensors | opaque))
    )
    assert_small(errors, gradient_error_max=1e-3)


def test_no_offset_is_an_offset_of_zero(rasterize):
    scene = random_scene(6, dtype=torch.float32)
    zero = replace(scene, tensors=scene.tensors | {"means2d_offset": torch.zeros(60, 2)})
    none = replace(scene, tensors=scene.tensors | {"means2d_offset": None})
    for image, image_of_none in zip(
        images_of(zero.render(rasterize)), images_of(none.render(rasterize)), strict=True
    ):
        assert torch.equal(image, image_of_none)


# --- nothing to see


@pytest.mark.parametrize("n", [0, 30])
def test_an_empty_view_shows_the_background(rasterize, n):
    scene = random_scene(0, n=n, dtype=torch.float32)
    assert_shows_the_background(rasterize, scene)


# --- the same bits on every run


def test_repeated_calls_give_the_same_bits(rasterize):
    scene = random_scene(8, 300, 101, 75, torch.float32)
    assert_same_bits(
        render_and_differentiate(rasterize, scene), render_and_differentiate(rasterize, scene)
    )


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one processor")
def test_the_number_of_threads_does_not_change_a_bit(rasterize):
    scene = random_scene(9, 300, 101, 75, torch.float32)
    before = numba.get_num_threads()
    results = []
    try:
        for threads in (1, 2):
            numba.set_num_threads(threads)
            results.append(render_and_differentiate(rasterize, scene))
    finally:
        numba.set_num_threads(before)
    assert_same_bits(*results)


def test_two_views_can_be_in_flight(rasterize):
    """Buffers may be kept between calls, but not those that an earlier result or its backward still
    needs."""
    first, second = (random_scene(seed, dtype=torch.float32).with_leaves() for seed in (12, 13))
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


# --- the tensors that callers hand over


def test_non_contiguous_inputs(rasterize):
    scene = random_scene(14, dtype=torch.float32)
    strided = replace(
        scene,
        tensors={
            name: torch.stack([t, t - 1], dim=-1)[..., 0] for name, t in scene.tensors.items()
        },
        viewmat=scene.viewmat.T.contiguous().T,
        K=scene.K.T.contiguous().T,
    )
    assert not strided.tensors["means"].is_contiguous()
    for name, tensor in strided.tensors.items():
        tensor.requires_grad_()
        assert torch.equal(tensor, scene.tensors[name])
    raster = strided.render(rasterize)
    sum(image.square().sum() for image in images_of(raster)).backward()
    grads = {name: tensor.grad for name, tensor in strided.tensors.items()}
    assert_same_bits(
        ([*images_of(raster), raster.radii], grads), render_and_differentiate(rasterize, scene)
    )


def test_non_contiguous_cotangents(rasterize):
    scene = random_scene(15, dtype=torch.float32)
    dense = render_and_differentiate(
        rasterize, scene, lambda images: sum((i * torch.ones_like(i)).sum() for i in images)
    )
    expanded = render_and_differentiate(
        rasterize, scene, lambda images: sum(i.sum() for i in images)
    )
    transposed = render_and_differentiate(
        rasterize, scene, lambda images: sum(i.transpose(0, 1).sum() for i in images)
    )
    assert_same_bits(dense, expanded)
    assert_same_bits(dense, transposed)


@pytest.mark.parametrize("used", range(6))
def test_a_loss_on_one_image_only(rasterize, used):
    scene = random_scene(16, dtype=torch.float32)
    _, grads = render_and_differentiate(
        rasterize, scene, lambda images: images[used].square().sum()
    )
    _, padded = render_and_differentiate(
        rasterize,
        scene,
        lambda images: sum((i.square() * (k == used)).sum() for k, i in enumerate(images)),
    )
    other = "thermal" if used < 3 else "rgb"
    for name, gradient in padded.items():
        assert torch.equal(
            gradient, torch.zeros_like(gradient) if grads[name] is None else grads[name]
        ), name
        assert not (name.startswith(other) and gradient.any()), name


def test_gradients_flow_only_into_what_requires_them(rasterize):
    scene = random_scene(17, dtype=torch.float32)
    _, all_grads = render_and_differentiate(rasterize, scene)
    for name in scene.tensors:
        alone = replace(scene, tensors={k: t.detach().clone() for k, t in scene.tensors.items()})
        alone.tensors[name].requires_grad_()
        sum(image.square().sum() for image in images_of(alone.render(rasterize))).backward()
        assert torch.equal(alone.tensors[name].grad, all_grads[name]), name
        assert all(tensor.grad is None for other, tensor in alone.tensors.items() if other != name)
    assert not any(image.requires_grad for image in images_of(scene.render(rasterize)))


@pytest.mark.parametrize("count", [60, CHUNK_ROWS + 1_000])
def test_images_are_the_same_without_gradients(rasterize, count):
    """Without them, ``CHUNK_ROWS`` Gaussians are projected at a time."""
    scene = random_scene(5, count, dtype=torch.float32)
    alone, expected = (images_of(each.render(rasterize)) for each in (scene, scene.with_leaves()))
    assert all(torch.equal(*pair) for pair in zip(alone, expected, strict=True))


def test_inputs_are_left_as_they_were(rasterize):
    scene = random_scene(18, dtype=torch.float32)
    before = {name: tensor.clone() for name, tensor in scene.tensors.items()}
    render_and_differentiate(rasterize, scene)
    assert all(torch.equal(tensor, before[name]) for name, tensor in scene.tensors.items())


def needles(dtype: torch.dtype) -> Geometry:
    """Slanting Gaussians, thousands of pixels long and a pixel wide: their quadratic form cancels
    in float32."""
    angle = 0.32
    means = torch.tensor([[0.0, 0.0, 1.0], [0.01, 0.0, 1.2], [0.0, 0.02, 1.4]], dtype=dtype)
    quats = torch.tensor([[math.cos(angle), 0.0, 0.0, math.sin(angle)]], dtype=dtype).repeat(3, 1)
    scales = torch.tensor([[30.0, 1e-4, 1e-4], [1.0, 1e-4, 1e-4], [5.0, 1e-4, 1e-4]], dtype=dtype)
    return Geometry(means, quats, scales)


def test_needles_keep_their_alpha(rasterize) -> None:
    alphas = []
    for function, dtype in ((rasterize, torch.float32), (reference.rasterize, torch.float64)):
        layer = Layer(
            *(torch.tensor(v, dtype=dtype) for v in ([0.9, 0.5, 0.4], [[0.5] * 3] * 3, [0.0] * 3))
        )
        K = torch.tensor([[600.0, 0, 50], [0, 600, 40], [0, 0, 1]], dtype=dtype)
        projection = Projection(torch.eye(4, dtype=dtype), K, 100, 80)
        raster = function(needles(dtype), [layer], projection)
        alphas.append(raster.blends[0].alpha.double())
    assert alphas[1].max() > 0.8
    assert (alphas[0] - alphas[1]).abs().max() < 1e-5


@pytest.mark.parametrize("dilation_px2", [DILATION_PX2, 0.1, LEAST_DILATION_PX2])
def test_gradients_of_needles(rasterize, dilation_px2: float) -> None:
    assert_gradients_of_needles(rasterize, dilation_px2)


@pytest.mark.parametrize("size", [3e38, float("inf"), float("nan")])
def test_a_gaussian_without_a_usable_size_is_left_out(rasterize, size: float) -> None:
    means, quats = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[0.9, 0.1, 0.3, 0.2]])
    layer = Layer(torch.tensor([0.5]), torch.ones(1, 3), torch.zeros(3))
    K = torch.tensor([[60.0, 0, 5], [0, 60, 4], [0, 0, 1]])
    geometry = Geometry(means, quats, torch.full((1, 3), size))
    raster = rasterize(geometry, [layer], Projection(torch.eye(4), K, 10, 8))
    assert raster.radii.tolist() == [0.0]
    assert raster.blends[0].alpha.max() == 0


def test_tensors_of_other_sizes_or_types_are_refused(rasterize) -> None:
    geometry = Geometry(torch.zeros(4, 3), torch.ones(4, 4), torch.ones(4, 3))
    layer = Layer(torch.ones(4), torch.ones(4, 3), torch.zeros(3))
    projection = Projection(torch.eye(4), torch.eye(3), 8, 8)
    plain = inspect.unwrap(rasterize)
    with pytest.raises(ValueError, match=r"quats must be float32 \[4, 4\] .*\[1, 4\]"):
        plain(geometry._replace(quats=torch.ones(1, 4)), [layer], projection)
    with pytest.raises(ValueError, match=r"scales must be float32 .* not float64"):
        plain(geometry._replace(scales=geometry.scales.double()), [layer], projection)
    with pytest.raises(ValueError, match=r"background must be float32 \[3\] .*\[4\]"):
        plain(geometry, [layer._replace(background=torch.zeros(4))], projection)


@pytest.mark.parametrize("channels", ANY_CHANNELS)
def test_layers_of_any_number_of_channels(rasterize, channels) -> None:
    assert_any_channels(rasterize, channels)


def test_a_layer_has_a_channel(rasterize) -> None:
    geometry = Geometry(torch.zeros(4, 3), torch.ones(4, 4), torch.ones(4, 3))
    empty = Layer(torch.ones(4), torch.ones(4, 0), torch.zeros(0))
    for layers in ([], [empty]):
        with pytest.raises(ValueError, match="layer"):
            rasterize(geometry, layers, Projection(torch.eye(4), torch.eye(3), 8, 8))


def test_an_image_changed_in_place_before_the_backward_is_noticed(rasterize) -> None:
    means = torch.tensor([[0.0, 0.0, 1.0]], requires_grad=True)
    layer = Layer(torch.tensor([0.5]), torch.ones(1, 3), torch.zeros(3))
    K = torch.tensor([[60.0, 0, 5], [0, 60, 4], [0, 0, 1]])
    geometry = Geometry(means, torch.ones(1, 4), torch.full((1, 3), 0.1))
    raster = rasterize(geometry, [layer], Projection(torch.eye(4), K, 10, 8))
    raster.blends[0].image.mul_(2)
    with pytest.raises(RuntimeError, match="inplace operation"):
        raster.blends[0].image.sum().backward()


if __name__ == "__main__":
    from mrgs.kernels.rasterize.cpu.rasterize import rasterize as kernel

    for error_name, largest in worst_errors(kernel).items():
        print(f"{error_name:26s} {largest:.1e}")
