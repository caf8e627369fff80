from __future__ import annotations

import dataclasses

import pytest
import torch

from mrgs.errors import ConfigError
from mrgs.field import FieldConfig, RadianceField, nearest_neighbours
from mrgs.field.spherical_harmonics import C0, evaluate_sh
from mrgs.scene import RGB, THERMAL, Gaussians
from tests.helpers.gaussians import NEAR_INFRARED, random_gaussians

CAMERA = torch.tensor([0.0, 0.0, -4.0], dtype=torch.float64)


def make_gaussians(field: RadianceField, count: int = 40, temperature_bands: int = 0) -> Gaussians:
    gaussians = random_gaussians(
        count, bands=temperature_bands, seed=1, modalities=(RGB, THERMAL, NEAR_INFRARED)
    )
    field.set_frame(gaussians.means)
    gaussians.embedding = field.initial_embedding(gaussians.means)
    return gaussians


def make_field(**options) -> RadianceField:
    torch.manual_seed(0)
    return RadianceField(FieldConfig(**options))


@pytest.mark.parametrize("residuals", [True, False])
def test_colors_are_clamped_harmonics_plus_the_residual(residuals):
    field = make_field(residuals=residuals)
    gaussians = make_gaussians(field)
    directions = torch.nn.functional.normalize(gaussians.means - CAMERA.float(), dim=1)
    expected = (
        evaluate_sh(gaussians.sh_dc[RGB], gaussians.sh_rest[RGB], directions, 2) + 0.5
    ).clamp_min(0)
    if residuals:
        expected = expected + field.color_head(gaussians.embedding, directions)
    torch.testing.assert_close(field.colors(gaussians, CAMERA, 2), expected)


def test_temperatures_are_the_papers_chain():
    field = make_field()
    gaussians = make_gaussians(field)
    neighbours = nearest_neighbours(gaussians.means, 8)
    harmonics = torch.cat([gaussians.sh_dc[RGB], gaussians.sh_rest[RGB]], dim=1)
    e_t = field.extraction(gaussians.embedding, harmonics)
    features = field.thermal_head(e_t, (gaussians.means - field.center) / field.scale)
    refined = field.heat(features, gaussians.opacity(THERMAL), neighbours)
    expected = C0 * gaussians.sh_dc[THERMAL][:, 0] + 0.5 + 0.01 * field.temperature_output(refined)
    torch.testing.assert_close(field.temperatures(gaussians, neighbours, CAMERA, 3), expected)


def test_temperatures_do_not_depend_on_the_view():
    field = make_field()
    gaussians = make_gaussians(field)
    neighbours = nearest_neighbours(gaussians.means, 8)
    here = field.temperatures(gaussians, neighbours, CAMERA, 3)
    assert torch.equal(here, field.temperatures(gaussians, neighbours, -2 * CAMERA, 0))
    assert not torch.allclose(
        field.colors(gaussians, CAMERA, 3), field.colors(gaussians, -2 * CAMERA, 3)
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_temperatures_of_a_higher_degree_add_their_harmonics_without_a_clamp(degree):
    field = make_field()
    gaussians = make_gaussians(field, temperature_bands=15)
    gaussians.sh_dc[THERMAL] -= 2
    neighbours = nearest_neighbours(gaussians.means, 8)
    found = field.temperatures(gaussians, neighbours, CAMERA, degree)
    directions = torch.nn.functional.normalize(gaussians.means - CAMERA.float(), dim=1)
    harmonics = evaluate_sh(
        torch.zeros_like(gaussians.sh_dc[THERMAL]), gaussians.sh_rest[THERMAL], directions, degree
    )
    gaussians.sh_rest[THERMAL] = gaussians.sh_rest[THERMAL][:, :0]
    torch.testing.assert_close(
        found, field.temperatures(gaussians, neighbours, CAMERA, degree) + harmonics
    )
    assert (found < 0).any()


def test_baseline_treats_temperature_like_a_colour():
    field = make_field(residuals=False)
    gaussians = make_gaussians(field, temperature_bands=15)
    directions = torch.nn.functional.normalize(gaussians.means - CAMERA.float(), dim=1)
    sh = evaluate_sh(gaussians.sh_dc[THERMAL], gaussians.sh_rest[THERMAL], directions, 3)
    torch.testing.assert_close(
        field.temperatures(gaussians, None, CAMERA, 3), (sh + 0.5).clamp_min(0)
    )
    assert gaussians.embedding.shape == (40, 0)
    assert not list(field.parameters())


@pytest.mark.parametrize("residuals", [True, False])
@pytest.mark.parametrize("rows", [None, torch.tensor([7, 3, 39])])
def test_any_other_modality_is_clamped_harmonics(residuals, rows):
    field = make_field(residuals=residuals)
    gaussians = make_gaussians(field)
    directions = torch.nn.functional.normalize(gaussians.means - CAMERA.float(), dim=1)
    dc, rest = gaussians.sh_dc[NEAR_INFRARED], gaussians.sh_rest[NEAR_INFRARED]
    expected = (evaluate_sh(dc, rest, directions, 2) + 0.5).clamp_min(0)
    found = field.intensities(NEAR_INFRARED, gaussians, CAMERA, 2, rows)
    torch.testing.assert_close(found, expected if rows is None else expected[rows])
    with pytest.raises(IndexError, match=r"rows .*0 to 39"):
        field.intensities(NEAR_INFRARED, gaussians, CAMERA, 2, torch.tensor([40]))


@pytest.mark.parametrize(
    "options",
    [
        {"neighbours_n": 3},
        {"neighbours_n": 1},
        {"neighbours_n": 2, "fourier": False},
        {"residuals": False},
    ],
)
@pytest.mark.parametrize("bands", [0, 3, 15])
def test_rows_give_the_same_values_as_all(options, bands):
    field = make_field(**options)
    gaussians = make_gaussians(field, temperature_bands=bands)
    k = field.config.neighbours_k
    neighbours = nearest_neighbours(gaussians.means, k) if k else None
    rows = torch.tensor([7, 3, 39, 20])
    torch.testing.assert_close(
        field.colors(gaussians, CAMERA, 3, rows), field.colors(gaussians, CAMERA, 3)[rows]
    )
    torch.testing.assert_close(
        field.temperatures(gaussians, neighbours, CAMERA, 3, rows),
        field.temperatures(gaussians, neighbours, CAMERA, 3)[rows],
    )


def test_every_parameter_and_the_thermal_inputs_get_a_gradient():
    field = make_field()
    gaussians = make_gaussians(field)
    for tensor in gaussians.tensors().values():
        tensor.requires_grad_()
    neighbours = nearest_neighbours(gaussians.means, 8)
    temperatures = field.temperatures(gaussians, neighbours, CAMERA, 3)
    (field.colors(gaussians, CAMERA, 3).square().sum() + temperatures.square().sum()).backward()
    for name, parameter in field.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name
    for name in (
        "means",
        "opacity_logit.thermal",
        "sh_dc.rgb",
        "sh_rest.rgb",
        "sh_dc.thermal",
        "embedding",
    ):
        assert gaussians.tensors()[name].grad.abs().sum() > 0, name


def test_start_is_close_to_the_plain_values():
    field = make_field()
    gaussians = make_gaussians(field)
    plain = make_field(residuals=False)
    difference = field.colors(gaussians, CAMERA, 3) - plain.colors(gaussians, CAMERA, 3)
    assert difference.abs().max() < 0.02


def test_the_same_seed_gives_the_same_field_and_state_restores_it():
    field, twin = make_field(), make_field()
    make_gaussians(field)
    for name, parameter in field.named_parameters():
        assert torch.equal(parameter, twin.get_parameter(name))
    twin.load_state_dict(field.state_dict())
    assert torch.equal(field.center, twin.center)
    assert torch.equal(field.scale, twin.scale)


def test_missing_neighbours_are_named():
    field = make_field()
    with pytest.raises(ValueError, match="8 nearest"):
        field.temperatures(make_gaussians(field), None, CAMERA, 3)


def test_neighbours_of_other_gaussians_are_refused():
    field = make_field()
    gaussians = make_gaussians(field)
    neighbours = nearest_neighbours(gaussians.means, 8)
    with pytest.raises(ValueError, match=r"40 .*\(39, 8\)"):
        field.temperatures(gaussians, neighbours[1:], CAMERA, 3)
    with pytest.raises(IndexError, match=r"neighbours .*to 39, .*to 40"):
        field.temperatures(gaussians, neighbours.clamp_min(1) + (neighbours == 39), CAMERA, 3)


@pytest.mark.parametrize("row", [-1, 40])
def test_rows_that_do_not_exist_are_refused(row):
    field = make_field()
    gaussians = make_gaussians(field)
    neighbours, rows = nearest_neighbours(gaussians.means, 8), torch.tensor([0, row])
    with pytest.raises(IndexError, match=r"rows .*0 to 39"):
        field.colors(gaussians, CAMERA, 3, rows)
    with pytest.raises(IndexError, match=r"rows .*0 to 39"):
        field.temperatures(gaussians, neighbours, CAMERA, 3, rows)


@pytest.mark.parametrize(
    ("options", "k"),
    [
        ({}, 8),
        ({"neighbours_n": 1}, 0),
        ({"neighbours_n": 5}, 24),
        ({"fourier": False}, 0),
        ({"residuals": False}, 0),
    ],
)
def test_number_of_neighbours(options, k):
    assert FieldConfig(**options).neighbours_k == k


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"embedding_width": 20}, "embedding_width .*20"),
        ({"position_frequencies": -1}, "position_frequencies .*-1"),
        ({"neighbours_n": 0}, "neighbours_n .*not 0"),
        ({"hidden_width": 10**9}, "hidden_width .*4,096"),
        ({"color_scale": float("nan")}, "color_scale .*nan"),
    ],
)
def test_impossible_configurations_are_named(options, message):
    with pytest.raises(ConfigError, match=message):
        dataclasses.replace(FieldConfig(), **options)


@pytest.mark.parametrize("bands", [0, 15])
def test_without_a_clamp_the_mirrored_scale_has_the_mirrored_temperatures(bands):
    field = make_field(residuals=False, clamp_temperature=False)
    gaussians = make_gaussians(field, temperature_bands=bands)
    dc, rest = gaussians.sh_dc[THERMAL].mul_(4).requires_grad_(), gaussians.sh_rest[THERMAL]
    temperatures = field.temperatures(gaussians, None, CAMERA, 3)
    (gradient,) = torch.autograd.grad(temperatures.sum(), dc)
    assert temperatures.min() < 0
    torch.testing.assert_close(gradient, torch.full_like(gradient, C0))
    dc.data.neg_()
    rest.neg_()
    mirrored = field.temperatures(gaussians, None, CAMERA, 3)
    torch.testing.assert_close(mirrored, 1 - temperatures)
