from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mrgs.errors import ConfigError
from mrgs.export.page.packing import MORTON_BITS, curve_rows, morton_order, smallest_three
from mrgs.scene import RGB, THERMAL
from tests.helpers.gaussians import NEAR_INFRARED
from tests.helpers.packed import as_model, pack, unpack


def test_every_parameter_comes_back_within_half_a_step(baked):
    packed = pack(baked)
    content = unpack(packed)
    rows = np.argmin(
        np.linalg.norm(content["means"][:, None] - baked.means.numpy(), axis=2), axis=1
    )
    assert sorted(rows) == list(range(600))
    expected = {name: baked.tensors()[name].numpy()[rows] for name in content}
    np.testing.assert_allclose(content["means"], expected["means"], atol=5 / 65535)
    np.testing.assert_allclose(content["scales"], expected["scales"], rtol=0.003)
    alike = np.abs((content["quats"] * expected["quats"]).sum(axis=1))
    assert np.degrees(2 * np.arccos(alike.clip(0, 1))).max() < 0.25
    np.testing.assert_allclose(content["opacity.rgb"], expected["opacity.rgb"], atol=0.51 / 255)
    np.testing.assert_allclose(
        content["opacity.thermal"], expected["opacity.thermal"], atol=0.51 / 65535
    )
    np.testing.assert_allclose(content["temperatures"], expected["temperatures"], atol=1e-5)
    steps = [
        (high - low) / steps
        for (low, high), steps in zip(
            packed.header["limits"]["sh"]["rgb"], packed.header["sh_steps"], strict=True
        )
    ]
    tolerance = 0.51 * np.repeat(steps, [1, 3, 5, 7])[:, None]
    found, wanted = (
        np.concatenate([each["sh_dc.rgb"], each["sh_rest.rgb"]], axis=1)
        for each in (content, expected)
    )
    assert (np.abs(found - wanted) <= tolerance).mean() > 0.999  # all but the clipped ones


def test_the_packed_model_renders_as_the_baked_one(baked, cameras):
    packed = as_model(unpack(pack(baked)), baked)
    for camera in cameras.values():
        before, after = baked.render(camera), packed.render(camera)
        error = (before[RGB].image.clamp(0, 1) - after[RGB].image.clamp(0, 1)).square().mean()
        assert -10 * error.log10() > 45
        error_c = (before[THERMAL].image - after[THERMAL].image).abs() * baked.temperature.span_c
        assert error_c.mean() < 0.03
        assert error_c.max() < 0.5  # one pixel at the steepest edge of a range of 100 °C


def test_a_third_modality_is_packed_with_the_precision_of_readings(with_nir, cameras):
    packed = pack(with_nir)
    assert {"opacity_nir", "sh_nir"} <= {name for name, _, _ in packed.header["planes"]}
    model = as_model(unpack(packed), with_nir)
    for camera in cameras.values():
        before, after = with_nir.render(camera), model.render(camera)
        assert (before[NEAR_INFRARED].image - after[NEAR_INFRARED].image).abs().mean() < 0.003


def test_only_what_is_shown_is_packed(baked):
    whole, colour = pack(baked), pack(baked, modalities=[RGB])
    assert not any("thermal" in name for name, _, _ in colour.header["planes"])
    assert len(colour.data) < len(whole.data)


def test_each_plane_starts_at_a_multiple_of_its_width(with_nir):
    """Typed arrays of JavaScript need it."""
    at = 0
    for _, kind, length in pack(with_nir).header["planes"]:
        assert at % np.dtype(kind).itemsize == 0
        at += np.dtype(kind).itemsize * length


def test_a_modality_without_view_dependence_is_packed_without_it(with_nir):
    rest = {**with_nir.sh_rest, NEAR_INFRARED: with_nir.sh_rest[NEAR_INFRARED][:, :0]}
    flat = replace(with_nir, sh_rest=rest)
    content = unpack(pack(flat))
    assert content["sh_dc.nir"].shape == (600, 1, 1)
    assert content["sh_rest.nir"].shape == (600, 0, 1)
    assert content["sh_rest.rgb"].shape == (600, 15, 3)


def test_splats_that_no_pixel_can_show_are_left_out(baked):
    opacity = torch.full_like(baked.opacities[RGB], 0.5)
    opacity[:100] = 0.003
    both = replace(baked, opacities=dict.fromkeys((RGB, THERMAL), opacity))
    assert pack(both).header["count"] == 500
    one = replace(baked, opacities={**baked.opacities, RGB: opacity})
    assert pack(one).header["count"] > 500


def test_a_splat_is_packed_from_the_opacity_on_that_a_pixel_can_show(baked):
    opacity = torch.zeros(len(baked))
    opacity[:3] = torch.tensor([0.9, 1.0, 1.1]) / 255
    faint = replace(baked, opacities={RGB: opacity, THERMAL: torch.zeros(len(baked))})
    rows = curve_rows(faint, (RGB, THERMAL))
    assert sorted(rows.tolist()) == [1, 2]
    with pytest.raises(ConfigError):
        curve_rows(faint, (THERMAL,))


def test_a_splat_far_away_costs_only_its_chunk_precision(baked):
    means = baked.means.clone()
    means[7] = 1e4
    content = unpack(pack(replace(baked, means=means)))
    distance = np.linalg.norm(content["means"][:, None] - means.numpy(), axis=2).min(axis=1)
    assert (distance < 1e-4).sum() >= 600 - 256


def test_packing_is_deterministic(baked):
    assert pack(baked) == pack(baked)


def test_an_invisible_model_is_named(baked):
    nothing = torch.zeros_like(baked.opacities[RGB])
    with pytest.raises(ConfigError, match="no splat"):
        pack(replace(baked, opacities=dict.fromkeys((RGB, THERMAL), nothing)))


def test_neighbours_on_the_curve_are_neighbours_in_space():
    means = np.random.default_rng(0).uniform(size=(4096, 3)).astype(np.float32)
    ordered = means[morton_order(means)]
    step = np.linalg.norm(np.diff(ordered, axis=0), axis=1).mean()
    assert step < 0.25 * np.linalg.norm(np.diff(means, axis=0), axis=1).mean()


@pytest.mark.slow
def test_the_curve_holds_together_where_there_are_more_ranks_than_it_has_bits():
    count = 2**MORTON_BITS + 4096
    means = np.random.default_rng(0).uniform(size=(count, 3)).astype(np.float32)
    step = np.linalg.norm(np.diff(means[morton_order(means)], axis=0), axis=1).mean()
    assert step < 0.05 * np.linalg.norm(np.diff(means, axis=0), axis=1).mean()


def test_both_signs_of_a_quaternion_are_one_rotation():
    quats = np.random.default_rng(1).normal(size=(50, 4)).astype(np.float32)
    np.testing.assert_array_equal(smallest_three(quats), smallest_three(-2 * quats))
