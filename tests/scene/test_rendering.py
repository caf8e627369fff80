from __future__ import annotations

import copy
import pickle

import pytest
import torch

from mrgs.scene import RGB, THERMAL, Blend, Camera, Rendering, ideal_cameras
from tests.helpers.gaussians import NEAR_INFRARED

MODALITIES = (RGB, THERMAL, NEAR_INFRARED)


def blend_of(channels: int, seed: int = 0) -> Blend:
    generator = torch.Generator().manual_seed(seed)
    sizes = ((3, 4, channels), (3, 4), (3, 4))
    return Blend(*(torch.rand(size, generator=generator) for size in sizes))


def make() -> Rendering:
    return Rendering({each: blend_of(each.channels, seed) for seed, each in enumerate(MODALITIES)})


def test_a_rendering_is_a_mapping_in_the_order_of_its_blends():
    blends = {THERMAL: blend_of(1), RGB: blend_of(3)}
    rendering = Rendering(blends)
    assert list(rendering) == [THERMAL, RGB]
    assert len(rendering) == 2
    assert rendering[RGB] is blends[RGB]
    assert NEAR_INFRARED not in rendering
    with pytest.raises(KeyError):
        rendering[NEAR_INFRARED]
    del blends[RGB]
    assert RGB in rendering


def test_images_are_replaced_and_depths_kept():
    rendering, image = make(), torch.zeros(3, 4, 1)
    found = rendering.with_images({THERMAL: image})
    assert list(found) == list(MODALITIES)
    assert found[THERMAL].image is image
    assert found[THERMAL].depth is rendering[THERMAL].depth
    assert found[THERMAL].alpha is rendering[THERMAL].alpha
    assert found[RGB] == rendering[RGB]
    assert rendering[THERMAL].image is not image


def test_an_image_of_what_was_not_rendered_is_left_out():
    rendering = Rendering({RGB: blend_of(3)})
    assert list(rendering.with_images({THERMAL: torch.zeros(3, 4, 1)})) == [RGB]


def test_images_in_the_hosts_memory_are_the_same():
    rendering = make()
    copied = rendering.cpu()
    assert list(copied) == list(rendering)
    for modality, blend in rendering.items():
        assert all(torch.equal(*pair) for pair in zip(copied[modality], blend, strict=True))


def test_ideal_cameras_change_nothing():
    rendering = make()
    camera = Camera(torch.eye(3, dtype=torch.float64), torch.eye(4, dtype=torch.float64), 4, 3)
    assert ideal_cameras(rendering, camera) is rendering


def test_an_image_alone_has_no_depth():
    image = torch.rand(3, 4, 1)
    blend = Blend.of_image(image)
    assert blend.image is image
    assert blend.depth.shape == blend.alpha.shape == (3, 4)
    alone = Rendering({THERMAL: blend, RGB: blend_of(3)})
    assert not alone.has_depth(THERMAL)
    assert alone.has_depth(RGB)
    assert alone.surface_depth(THERMAL).isnan().all()


def test_a_median_depth_comes_before_the_blended_one():
    """It is also that of images without an alpha, which other programs rendered."""
    median = torch.tensor([[2.0, torch.nan]])
    for blend in (Blend.of_image(torch.zeros(1, 2, 1)), Blend(*torch.ones(3, 1, 2).split(1))):
        blend = Blend(blend.image, blend.depth.view(1, 2), blend.alpha.view(1, 2))
        rendering = Rendering({THERMAL: blend}, {THERMAL: median})
        assert rendering.has_depth(THERMAL)
        for same in (rendering, rendering.cpu(), rendering.with_images({THERMAL: blend.image})):
            torch.testing.assert_close(same.surface_depth(THERMAL), median, equal_nan=True)


def test_a_median_depth_is_found_once_and_only_if_it_is_asked_for():
    calls = []

    def find() -> torch.Tensor:
        calls.append(1)
        return torch.tensor([[2.0, 3.0]])

    blend = Blend(torch.zeros(1, 2, 1), torch.ones(1, 2), torch.ones(1, 2))
    rendering = Rendering({THERMAL: blend}, {THERMAL: find})
    others = [rendering.cpu(), rendering.with_images({})]
    assert all(each.has_depth(THERMAL) for each in (rendering, *others))
    assert not calls
    for each in (rendering, *others, rendering):
        assert torch.equal(each.surface_depth(THERMAL), torch.tensor([[2.0, 3.0]]))
    assert len(calls) == 1


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda it: pickle.loads(pickle.dumps(it))])
def test_a_rendering_can_leave_a_process_and_takes_its_depths_along(copied):
    blends = {THERMAL: blend_of(1), RGB: blend_of(3), NEAR_INFRARED: blend_of(1)}
    found, given = torch.full((3, 4), 2.0), torch.full((3, 4), 3.0)
    rendering = Rendering(blends, {THERMAL: lambda: found, RGB: given}).cpu()
    again = copied(rendering)
    assert list(again) == list(rendering)
    for modality, blend in rendering.items():
        assert all(torch.equal(*pair) for pair in zip(again[modality], blend, strict=True))
        depths = (each.surface_depth(modality, min_alpha=0.0) for each in (again, rendering))
        assert torch.equal(*depths)


def test_the_depth_is_that_of_the_first_or_of_another_that_has_one():
    unknown = Blend.of_image(torch.rand(3, 4, 3))
    assert make().with_depth(THERMAL) == THERMAL
    assert Rendering({RGB: unknown, THERMAL: blend_of(1)}).with_depth(RGB) == THERMAL
    assert Rendering({RGB: unknown}).with_depth(RGB) is None
    assert Rendering({RGB: blend_of(3)}).with_depth(THERMAL) == RGB


def surfaces(depths: list[list[float]], alphas: list[list[float]]) -> Rendering:
    """A thermal image whose surfaces have these depths."""
    alpha = torch.tensor(alphas)
    blend = Blend(torch.zeros(*alpha.shape, 1), torch.tensor(depths) * alpha, alpha)
    return Rendering({THERMAL: blend})


def test_a_surfaces_depth_is_that_of_the_blend_without_the_background():
    rendering = surfaces([[2.0, 2.0, 3.0]], [[0.8, 0.5, 0.4]])
    expected = torch.tensor([[2.0, 2.0, torch.nan]])
    torch.testing.assert_close(rendering.surface_depth(THERMAL), expected, equal_nan=True)
    expected[0, 1] = torch.nan
    torch.testing.assert_close(
        rendering.surface_depth(THERMAL, min_alpha=0.6), expected, equal_nan=True
    )


def test_outlines_have_no_depth_where_they_are_not_wanted():
    """A near and a far surface, both slightly slanted, and a hole, which is no outline of what is
    beside it."""
    row = [2.0, 2.01, 2.02, 4.0, 4.02, 4.04, 9.0, 4.1]
    rendering = surfaces([row] * 3, [[1.0] * 6 + [0.1, 1.0]] * 3)
    found = rendering.surface_depth(THERMAL, max_step=0.05)
    expected = torch.tensor([row] * 3)
    expected[:, [2, 3, 6]] = torch.nan
    torch.testing.assert_close(found, expected, equal_nan=True)
    assert rendering.surface_depth(THERMAL).isnan().sum() == 3
