"""What `mrgs-plus` makes of the thermal photos: squares of what is noise, and smoothness
where the colours are smooth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest
import torch

from mrgs.method.config import make_config
from mrgs.method.losses.photometric import photometric_loss
from mrgs.method.losses.smoothness import similarity_of, total_variation
from mrgs.method.losses.term import LossContext, SceneScale, Term
from mrgs.method.losses.terms import configured_terms, term_values
from mrgs.rasterizer.contract import Dilation
from mrgs.scene import RGB, THERMAL, Blend, Camera, Modality, Pixels, Rendering
from tests.helpers.gaussians import random_gaussians
from tests.helpers.views import not_rendered, small_camera

HEIGHT, WIDTH = 6, 8
NOISE = 0.01


def values(channels: int, seed: int) -> torch.Tensor:
    return torch.rand(HEIGHT, WIDTH, channels, generator=torch.Generator().manual_seed(seed))


def shown(modality: Modality, seed: int) -> Blend:
    opaque = torch.ones(HEIGHT, WIDTH)
    return Blend(values(modality.channels, seed), 3 * opaque, opaque)


def context(cameras: Mapping[Modality, Camera], render=not_rendered) -> LossContext:
    rendering = Rendering({each: shown(each, 1) for each in cameras})
    photos = {each: Pixels(values(each.channels, 2), None) for each in cameras}
    gaussians, scale = random_gaussians(3), SceneScale(3.0, None, NOISE)
    return LossContext(rendering, rendering, photos, cameras, gaussians, Dilation(), scale, render)


def terms_of(method: str) -> dict[str, Term]:
    return {term.name: term for term in configured_terms(make_config(method, "fast"))}


@pytest.mark.parametrize("method", ["mrgs", "mrgs-plus", "3dgs-rgbt"])
def test_differences_as_small_as_the_noise_are_squared_in_the_temperatures_alone(method):
    seen = context(dict.fromkeys((RGB, THERMAL), small_camera()))
    config = make_config(method, "fast").loss
    found = term_values(list(terms_of(method).values()), seen)
    widths = {RGB: 0.0, THERMAL: config.huber_noise * NOISE}
    assert (widths[THERMAL] > 0) == (method == "mrgs-plus")
    for modality, width in widths.items():
        image, photo = seen.rendering[modality].image, seen.photos[modality].values
        expected = photometric_loss(image, photo, None, config.dssim, width)
        torch.testing.assert_close(found[modality.name], expected)


@pytest.mark.parametrize("noise", [NOISE, 0.0])
def test_temperatures_may_change_where_the_colours_do(noise):
    seen = replace(
        context(dict.fromkeys((RGB, THERMAL), small_camera())), scale=SceneScale(3.0, None, noise)
    )
    everywhere, alike = make_config("mrgs-plus", "fast").loss.smooth_image(THERMAL, noise, 1.0)
    assert (everywhere > 0) == (noise > 0)
    temperatures, colors = seen.rendering[THERMAL].image, seen.rendering[RGB].image
    guided = alike * total_variation(temperatures, None, *similarity_of(colors))
    expected = everywhere * total_variation(temperatures) + guided
    value = terms_of("mrgs-plus")["smooth"].value(seen)
    assert value is not None
    torch.testing.assert_close(value, expected)
    assert guided < 0.2 * alike * total_variation(temperatures)


def test_without_rgb_photos_there_is_no_guide():
    """The colours are those of the start points then; and ``not_rendered`` is not asked."""
    seen = context({THERMAL: small_camera()})
    seen = replace(seen, scale=seen.scale._replace(rgb_per_thermal=0))
    everywhere, _ = make_config("mrgs-plus", "fast").loss.smooth_image(THERMAL, NOISE, 0)
    value = terms_of("mrgs-plus")["smooth"].value(seen)
    assert value == everywhere * total_variation(seen.rendering[THERMAL].image) > 0


def test_a_thermal_camera_of_its_own_renders_the_colours_once():
    """For the smoothness and for L_opaque."""
    asked = []

    def render(cameras: Mapping[Modality, Camera]) -> Rendering:
        asked.append((dict(cameras), torch.is_grad_enabled()))
        return Rendering({RGB: shown(RGB, 3)})

    cameras = {RGB: small_camera(), THERMAL: small_camera(0.2)}
    seen = context(cameras, render)
    terms = terms_of("mrgs-plus")
    for name in ("smooth", "opaque"):
        assert terms[name].value(seen) is not None
    assert asked == [({RGB: cameras[THERMAL]}, False)]
    everywhere, alike = make_config("mrgs-plus", "fast").loss.smooth_image(THERMAL, NOISE, 1.0)
    similarity = similarity_of(values(3, 3), everywhere / (everywhere + alike))
    expected = total_variation(seen.rendering[THERMAL].image, None, *similarity)
    assert terms["smooth"].value(seen) == (everywhere + alike) * expected


def test_a_lamp_that_widens_the_scale_takes_nothing_from_the_rest():
    """Loss and smoothness of temperatures are those of the scale without it."""
    without = context(dict.fromkeys((RGB, THERMAL), small_camera()))
    full = make_config("mrgs-plus", "fast").loss.full_contrast
    assert full is not None
    scale = without.scale._replace(thermal_contrast=full, thermal_noise=full / 80)
    without = replace(without, scale=scale)
    blend, photo = without.rendering[THERMAL], without.photos[THERMAL]
    rendering = without.rendering.with_images({THERMAL: blend.image / 8})
    within = replace(
        without,
        rendering=rendering,
        observed=rendering,
        photos={**without.photos, THERMAL: Pixels(photo.values / 8, None)},
        scale=scale._replace(thermal_contrast=full / 8, thermal_noise=full / 640),
    )
    terms = [term for name, term in terms_of("mrgs-plus").items() if name != "distortion"]
    torch.testing.assert_close(term_values(terms, within), term_values(terms, without))


def test_contrast_of_full_size_or_of_noise_alone_is_not_raised():
    loss = make_config("mrgs-plus", "fast").loss
    assert loss.gain(THERMAL, 0.7, 0.0) == loss.gain(RGB, 0.01, 0.0) == 1
    assert loss.gain(THERMAL, 0.003, 0.001) == pytest.approx(loss.full_contrast / 0.05)
    assert make_config("mrgs", "fast").loss.gain(THERMAL, 0.01, 0.0) == 1
