from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from mrgs.rasterizer import Geometry, Layer, rasterize
from mrgs.rasterizer.contract import Dilation
from mrgs.scene import RGB, THERMAL
from mrgs.scene.rendering import SOLID_ALPHA
from mrgs.viewer.panes import read_point
from tests.helpers.subjects import subject_of


def solid_pixel(rendering) -> tuple[int, int]:
    row, column = divmod(int(rendering[THERMAL].alpha.argmax()), rendering[THERMAL].alpha.shape[1])
    return row, column


def test_a_reading_is_the_rendered_value_at_its_place(small_run, camera, subject):
    rendering = small_run.render(camera)
    row, column = solid_pixel(rendering)
    reading = read_point(small_run.model, camera, (column + 0.5) / 160, (row + 0.5) / 120, subject)
    assert reading.values[THERMAL].value == pytest.approx(
        small_run.temperatures_c(rendering)[row, column].item(), abs=1e-3
    )
    assert reading.depth == pytest.approx(
        rendering.surface_depth(THERMAL)[row, column].item(), rel=1e-5
    )
    pixel, z = camera.project(torch.from_numpy(reading.position))
    assert (*pixel.tolist(), z.item()) == pytest.approx(
        (column + 0.5, row + 0.5, reading.depth), rel=1e-5
    )


def test_the_spread_is_that_of_the_pixels_splats(small_run, camera, subject):
    """Against the weights of the splats, each rendered alone in a channel of its own."""
    model = replace(small_run.model, dilation=Dilation(40.0))  # far from any other
    row, column = solid_pixel(small_run.render(camera))
    gaussians = model.gaussians
    count = len(gaussians)
    weights = torch.zeros(count)
    for first in range(0, count, 3):
        features = torch.eye(count)[:, first : first + 3]
        features = torch.nn.functional.pad(features, (0, 3 - features.shape[1]))
        layer = Layer(gaussians.opacity(THERMAL), features, torch.zeros(3))
        projection = model.dilation.projection(camera, gaussians.means.device)
        raster = rasterize(Geometry.of(gaussians), [layer], projection)
        weights[first : first + 3] = raster.blends[0].image[row, column][: min(3, count - first)]
    weights = weights.double()
    alpha = weights.sum()
    reading = read_point(model, camera, (column + 0.5) / 160, (row + 0.5) / 120, subject)
    depths = gaussians.means.double() @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    variance = (weights * (depths - reading.depth).square()).sum() / alpha
    assert reading.depth_deviation == pytest.approx(variance.sqrt().item(), rel=1e-3)
    celsius = small_run.temperature.to_celsius(
        small_run.model.values(THERMAL, torch.zeros(3))[:, 0].double()
    )
    variance = (weights * (celsius - reading.values[THERMAL].value).square()).sum()
    variance += (1 - alpha) * (small_run.temperature.min_c - reading.values[THERMAL].value) ** 2
    assert reading.values[THERMAL].deviation == pytest.approx(variance.sqrt().item(), rel=1e-3)


def test_where_nothing_is_nothing_is_read(small_run, camera, subject):
    assert small_run.render(camera)[RGB].alpha[0, 0] < SOLID_ALPHA
    assert read_point(small_run.model, camera, 0.0, 0.0, subject) is None


def test_what_is_cold_and_transparent_to_the_thermal_blend_is_read_all_the_same(
    small_run, camera, subject
):
    gaussians = small_run.model.gaussians
    logits = gaussians.opacity_logits
    invisible = torch.full_like(logits[THERMAL], -9.0)
    faint = replace(gaussians, opacity_logits={**logits, THERMAL: invisible})
    reading = read_point(replace(small_run.model, gaussians=faint), camera, 0.5, 0.5, subject)
    assert reading.values[THERMAL].value == pytest.approx(subject.temperature.min_c, abs=0.01)
    rendering = small_run.render(camera)
    assert reading.depth == pytest.approx(rendering.surface_depth(RGB)[60, 80].item(), rel=1e-5)


def test_without_celsius_values_are_normalised(small_run, camera, subject):
    rendering = small_run.render(camera)
    row, column = solid_pixel(rendering)
    unknown = replace(subject, temperature=None)
    reading = read_point(small_run.model, camera, (column + 0.5) / 160, (row + 0.5) / 120, unknown)
    assert reading.values[THERMAL].value == pytest.approx(
        rendering[THERMAL].image[row, column, 0].item(), abs=1e-5
    )


def test_without_thermal_the_colour_blend_gives_the_depth(small_run, camera, subject):
    views = tuple(replace(view, images={RGB: view.images[RGB]}) for view in subject.scene.train)
    scene = replace(subject.scene, train=views)
    colour_only = subject_of(small_run, scene, subject.folder)
    rendering = small_run.render(camera)
    row, column = divmod(int(rendering[RGB].alpha.argmax()), 160)
    reading = read_point(
        small_run.model, camera, (column + 0.5) / 160, (row + 0.5) / 120, colour_only
    )
    assert reading.values == {}
    assert reading.depth == pytest.approx(
        rendering.surface_depth(RGB)[row, column].item(), rel=1e-5
    )


def test_temperatures_that_depend_on_the_view_are_read_from_where_one_looks(
    small_run, camera, subject
):
    rest = 0.2 * torch.randn(
        len(small_run.model.gaussians), 15, 1, generator=torch.Generator().manual_seed(0)
    )
    gaussians = small_run.model.gaussians
    gaussians = replace(gaussians, sh_rest={**gaussians.sh_rest, THERMAL: rest})
    model = replace(small_run.model, gaussians=gaussians)
    row, column = solid_pixel(small_run.render(camera))
    flat, reading = (
        read_point(which, camera, (column + 0.5) / 160, (row + 0.5) / 120, subject)
        for which in (small_run.model, model)
    )
    rendering = replace(small_run, model=model).render(camera)
    assert reading.values[THERMAL].value == pytest.approx(
        small_run.temperatures_c(rendering)[row, column].item(), abs=1e-3
    )
    assert abs(reading.values[THERMAL].value - flat.values[THERMAL].value) > 0.01
    assert abs(reading.values[THERMAL].deviation - flat.values[THERMAL].deviation) > 0.01


def test_a_model_in_training_is_read_too(small_run, camera, subject):
    """Its t̂ is not computed beforehand."""
    known = read_point(small_run.model, camera, 0.5, 0.5, subject)
    live = read_point(
        replace(small_run.model, temperature_residuals=None), camera, 0.5, 0.5, subject
    )
    assert live.values[THERMAL].value == pytest.approx(known.values[THERMAL].value, abs=1e-3)
    assert live.values[THERMAL].deviation == pytest.approx(
        known.values[THERMAL].deviation, abs=1e-3
    )
