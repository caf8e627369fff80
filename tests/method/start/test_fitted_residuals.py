from __future__ import annotations

import pytest
import torch

from mrgs.field import FieldConfig, RadianceField, nearest_neighbours
from mrgs.field.spherical_harmonics import C0
from mrgs.method.start.fitted_residuals import ROWS, fit_residuals, leave_the_rest
from mrgs.scene import RGB, THERMAL, Gaussians
from mrgs.system.operation import Operation
from tests.helpers.gaussians import random_gaussians

pytestmark = pytest.mark.compares_kernels

CAMERA = torch.zeros(3)


def start(
    kind: type[RadianceField] = RadianceField, count: int = 200, **options
) -> tuple[RadianceField, Gaussians, torch.Tensor]:
    """A field and Gaussians whose temperature rises along x; the last ten are seen by no photo."""
    torch.manual_seed(0)
    field = kind(FieldConfig(temperature_scale=1.0, **options))
    gaussians = random_gaussians(count, bands=0, seed=1, modalities=(RGB, THERMAL))
    field.set_frame(gaussians.means)
    gaussians.sh_rest[RGB] = torch.zeros_like(gaussians.sh_rest[RGB])
    gaussians.embedding = field.initial_embedding(gaussians.means)
    x = gaussians.means[:, :1]
    temperatures = 0.2 + 0.6 * (x - x.min()) / (x.max() - x.min())
    temperatures[-10:] = torch.nan
    gaussians.sh_dc[THERMAL] = ((temperatures.nan_to_num(nan=0.5) - 0.5) / C0)[:, None]
    return field, gaussians, temperatures


def temperatures_of(field: RadianceField, gaussians: Gaussians) -> torch.Tensor:
    neighbours = nearest_neighbours(gaussians.means, field.config.neighbours_k)
    with torch.no_grad():
        return field.temperatures(gaussians, neighbours, CAMERA, 0, color_degree=0)


def test_temperatures_stay_those_of_the_photos_and_the_residual_carries_them() -> None:
    field, gaussians, temperatures = start()
    fit_residuals(field, gaussians, temperatures, 100, torch.Generator().manual_seed(0))
    found = temperatures_of(field, gaussians)
    torch.testing.assert_close(found[:-10], temperatures[:-10], atol=1e-5, rtol=0)
    own = C0 * gaussians.sh_dc[THERMAL][:-10, 0, 0]
    assert own.std() < 0.3 * temperatures[:-10].std()


def test_gaussians_that_are_added_later_have_the_temperatures_of_the_photos_too() -> None:
    field, gaussians, temperatures = start()
    fit_residuals(field, gaussians, temperatures, 50, torch.Generator().manual_seed(0))
    gaussians.means = gaussians.means + 0.1
    gaussians.embedding = field.initial_embedding(gaussians.means)
    assert (temperatures_of(field, gaussians) - temperatures)[:-10].abs().max() > 0.01
    leave_the_rest(field, gaussians, temperatures, field.neighbours_of(gaussians.means))
    found = temperatures_of(field, gaussians)
    torch.testing.assert_close(found[:-10], temperatures[:-10], atol=1e-5, rtol=0)


def test_a_gaussian_that_no_photo_shows_takes_what_the_layers_know_of_its_place() -> None:
    field, gaussians, temperatures = start(position_frequencies=2)
    fit_residuals(field, gaussians, temperatures, 150, torch.Generator().manual_seed(0))
    assert (gaussians.sh_dc[THERMAL][-10:] == 0).all()
    x = gaussians.means[:, :1]
    expected = 0.2 + 0.6 * (x - x.min()) / (x.max() - x.min())
    error = (temperatures_of(field, gaussians) - expected)[-10:].abs()
    assert error.mean() < 0.5 * (expected - 0.5)[-10:].abs().mean()


@pytest.mark.parametrize(
    ("options", "steps", "known"),
    [({}, 0, True), ({"residuals": False}, 50, True), ({}, 50, False)],
)
def test_nothing_happens_without_steps_residuals_or_photos(options, steps, known) -> None:
    field, gaussians, temperatures = start(**options)
    if not known:
        temperatures = torch.full_like(temperatures, torch.nan)
    before = gaussians.sh_dc[THERMAL].clone()
    state = {name: tensor.clone() for name, tensor in field.state_dict().items()}
    fit_residuals(field, gaussians, temperatures, steps, torch.Generator())
    assert torch.equal(gaussians.sh_dc[THERMAL], before)
    for name, tensor in field.state_dict().items():
        assert torch.equal(tensor, state[name])


def test_an_edited_equation_is_fitted_and_not_its_kernel() -> None:
    operation = RadianceField.temperature_residuals
    edited = Operation(lambda *arguments: 2 * operation.plain(*arguments))
    edited.name = operation.name
    field, gaussians, temperatures = start(
        type("Edited", (RadianceField,), {"temperature_residuals": edited})
    )
    fit_residuals(field, gaussians, temperatures, 20, torch.Generator().manual_seed(0))
    assert edited.rejected
    found = temperatures_of(field, gaussians)
    torch.testing.assert_close(found[:-10], temperatures[:-10], atol=1e-5, rtol=0)


def test_the_kernel_is_checked_on_few_gaussians() -> None:
    """The plain definition takes memory for all that it is given."""
    operation = RadianceField.temperature_residuals
    sizes = []

    def plain(field: RadianceField, gaussians: Gaussians, *others: object) -> torch.Tensor:
        sizes.append(len(gaussians))
        return operation.plain(field, gaussians, *others)

    checked = Operation(plain)
    checked.name = operation.name
    kind = type("Checked", (RadianceField,), {"temperature_residuals": checked})
    fit_residuals(*start(kind, ROWS + 100), 2, torch.Generator().manual_seed(0))
    assert set(sizes) == {ROWS}
    assert not checked.rejected
