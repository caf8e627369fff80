from __future__ import annotations

import pytest
import torch

from mrgs.field import FieldConfig, RadianceField, nearest_neighbours
from mrgs.method.parts import knock_outs, part_spreads
from mrgs.rasterizer.contract import Dilation
from mrgs.render import Model
from mrgs.scene import RGB, THERMAL
from tests.helpers.gaussians import random_gaussians

CAMERA = torch.tensor([0.0, 0.0, -4.0])


def make_model(count: int = 40, **options) -> Model:
    torch.manual_seed(0)
    field = RadianceField(FieldConfig(color_scale=1.0, temperature_scale=1.0, **options))
    gaussians = random_gaussians(count, bands=0, seed=1, modalities=(RGB, THERMAL))
    field.set_frame(gaussians.means)
    gaussians.embedding = field.initial_embedding(gaussians.means)
    k = field.config.neighbours_k
    neighbours = nearest_neighbours(gaussians.means, k) if k > 0 else None
    return Model(gaussians, field, neighbours, dilation=Dilation())


def values(model: Model) -> tuple[torch.Tensor, torch.Tensor]:
    with torch.no_grad():
        return model.values(RGB, CAMERA), model.values(THERMAL, CAMERA)


def test_each_copy_lacks_one_part() -> None:
    model = make_model()
    colors, temperatures = values(model)
    copies = knock_outs(model)
    assert set(copies) == {
        "temperature_residual",
        "color_residual",
        "heat_exchange",
        "shuffled_neighbours",
    }
    for part, copy in copies.items():
        changed = values(copy)
        assert torch.equal(changed[0], colors) is (part != "color_residual")
        assert torch.equal(changed[1], temperatures) is (part == "color_residual")


def test_the_mean_residual_is_the_same_for_all() -> None:
    model = make_model()
    flat = knock_outs(model)["temperature_residual"].temperature_residuals
    assert flat is not None
    with torch.no_grad():
        residuals = model.field.temperature_residuals(model.gaussians, model.neighbours)
    torch.testing.assert_close(flat, residuals.mean().expand_as(residuals))


def test_without_heat_exchange_the_features_are_not_refined() -> None:
    model = make_model()
    field = model.field
    alone = knock_outs(model)["heat_exchange"].temperature_residuals
    sh = torch.cat([model.gaussians.sh_dc[RGB], model.gaussians.sh_rest[RGB]], dim=1)
    e_t = field.extraction(model.gaussians.embedding, sh)
    features = field.thermal_head(e_t, field.normalised(model.gaussians.means))
    torch.testing.assert_close(alone, field.temperature_output(features).detach())


def test_without_colour_residuals_the_colours_are_the_harmonics() -> None:
    model = make_model()
    plain = make_model(residuals=False)
    torch.testing.assert_close(values(knock_outs(model)["color_residual"])[0], values(plain)[0])


def test_spreads() -> None:
    model = make_model()
    spreads = part_spreads(model, CAMERA)
    assert spreads is not None
    with torch.no_grad():
        residuals = model.field.temperature_residuals(model.gaussians, model.neighbours)
        alone = knock_outs(model)["heat_exchange"].temperature_residuals
    assert spreads.temperature_residual == pytest.approx(residuals.std().item())
    assert spreads.heat_exchange == pytest.approx((residuals - alone).std().item(), rel=1e-3)
    assert spreads.color_residual > 0


def test_neighbours_that_are_not_known_yet_are_searched() -> None:
    model = make_model()
    expected = part_spreads(model, CAMERA)
    model.neighbours = None
    assert part_spreads(model, CAMERA) == expected


def test_a_field_without_a_part_has_nothing_to_knock_out() -> None:
    assert set(knock_outs(make_model(fourier=False))) == {"temperature_residual", "color_residual"}
    spreads = part_spreads(make_model(fourier=False), CAMERA)
    assert spreads is not None
    assert spreads.heat_exchange == 0
    assert knock_outs(make_model(residuals=False)) == {}
    assert part_spreads(make_model(residuals=False), CAMERA) is None
