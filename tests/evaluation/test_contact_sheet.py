from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from mrgs.evaluation.contact_sheet import (
    CELL_PX,
    SheetRows,
    ViewImages,
    contact_sheet,
)
from mrgs.evaluation.evaluate import Metrics, ViewMetrics, evaluate
from mrgs.evaluation.metrics import Missing
from mrgs.evaluation.report import RunFacts
from mrgs.pictures.sheet import HEADING_PX, MARGIN_PX
from mrgs.scene import RGB, THERMAL, Rendering, SceneBounds, TemperatureRange, View, evenly_spaced
from tests.helpers.gaussians import NEAR_INFRARED
from tests.helpers.views import CELSIUS, ramp_view, render_with_error, rendering_of

FACTS = RunFacts("mrgs", "board", 1200, 41_000, 63.5, None, "cpu")
Render = Callable[[View], Rendering]


def rows_of(
    views: list[View], render: Render, temperature: TemperatureRange | None
) -> tuple[list[tuple[ViewMetrics, ViewImages]], Metrics]:
    rows: list[tuple[ViewMetrics, ViewImages]] = []

    def visit(view: View, rendering: Rendering, metrics: ViewMetrics) -> None:
        rows.append((metrics, ViewImages.of(view, rendering, temperature)))

    return rows, evaluate(views, render, temperature, visit=visit)


def draw(views: list[View], render: Render, temperature: TemperatureRange | None) -> np.ndarray:
    rows, metrics = rows_of(views, render, temperature)
    return np.asarray(contact_sheet(rows, FACTS, metrics, temperature))


def test_a_column_per_image_and_a_row_per_view() -> None:
    one = draw([ramp_view("a")], render_with_error, CELSIUS)
    two = draw([ramp_view("a"), ramp_view("b")], render_with_error, CELSIUS)
    assert two.shape[1] == one.shape[1] > 6 * CELL_PX
    assert two.shape[0] - one.shape[0] > CELL_PX * 3 // 4
    thermal_only = draw([ramp_view("a", rgb=False)], render_with_error, CELSIUS)
    assert 4 * CELL_PX < thermal_only.shape[1] < 5 * CELL_PX


def test_with_aligned_poses_the_heading_says_so_and_has_their_means() -> None:
    rows, metrics = rows_of([ramp_view("a")], render_with_error, CELSIUS)
    means = {each: figures | {"psnr": 77.77} for each, figures in metrics.mean.items()}
    better = replace(metrics, mean=means)

    def drawn(metrics: Metrics) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The left and the right of the heading, and what lies below it."""
        sheet = np.asarray(contact_sheet(rows, FACTS, metrics, CELSIUS))
        end, half = MARGIN_PX + HEADING_PX, sheet.shape[1] // 2
        return sheet[:end, :half], sheet[:end, half:], sheet[end:]

    (plain, given, below), (says_so, theirs, same) = (
        drawn(metrics),
        drawn(replace(metrics, aligned=better)),
    )
    assert not np.array_equal(says_so, plain)
    assert not np.array_equal(theirs, given)
    np.testing.assert_array_equal(theirs, drawn(better)[1])
    np.testing.assert_array_equal(same, below)


def test_a_model_without_depth_has_no_depth_column() -> None:
    full = draw([ramp_view()], render_with_error, CELSIUS)
    shallow = draw(
        [ramp_view()],
        lambda view: rendering_of(
            {each: blend.image for each, blend in render_with_error(view).items()}
        ),
        CELSIUS,
    )
    assert CELL_PX <= full.shape[1] - shallow.shape[1] < CELL_PX + 20


def test_the_background_is_infinitely_far() -> None:
    view = ramp_view()
    rendering = render_with_error(view)
    rendering[RGB].depth[:5] = 900.0
    ball = SceneBounds(view.images[RGB].camera.position, 10.0)
    row = ViewImages.of(view, rendering, None, ball)
    assert np.isinf(row.depth[:5]).all()
    assert (row.depth[5:] == 2).all()


def shown_of(thermal: list[float | Missing], rgb: list[float | Missing]) -> list[int]:
    """The numbers of the views that a sheet shows, by their PSNR."""
    shown, made = SheetRows(len(thermal)), []
    for number, psnrs in enumerate(zip(thermal, rgb, strict=True)):
        figures = {
            modality: {"psnr": psnr} for modality, psnr in zip((THERMAL, RGB), psnrs, strict=True)
        }
        metrics = ViewMetrics(str(number), figures, None)

        def make(metrics: ViewMetrics = metrics) -> ViewImages:
            made.append(metrics.name)
            return ViewImages({}, {}, None)

        shown.add(number, metrics, make)
    assert {metrics.name for metrics, _ in shown.rows} <= set(made)
    return [int(metrics.name) for metrics, _ in shown.rows]


@pytest.mark.parametrize("bad", [20.0, math.nan])
@pytest.mark.parametrize("worst", [0, 5, 12])
def test_the_worst_view_is_shown_besides_those_spread_evenly(worst: int, bad: float) -> None:
    psnrs: list[float | Missing] = [30.0 + 0.1 * number for number in range(13)]
    psnrs[worst] = bad
    assert shown_of(psnrs, [30.0] * 13) == sorted({*evenly_spaced(13), worst})


def test_each_modality_has_its_worst_view() -> None:
    none = Missing("the view has none")
    thermal: list[float | Missing] = [40.0] * 13
    rgb: list[float | Missing] = [30.0] * 13
    thermal[4], rgb[4] = 25.0, none
    thermal[7], rgb[7] = none, 24.0
    assert shown_of(thermal, rgb) == sorted({*evenly_spaced(13), 4, 7})


def test_the_error_changes_the_picture() -> None:
    rows, metrics = rows_of([ramp_view()], render_with_error, CELSIUS)
    view, images = rows[0]
    images.renderings[THERMAL][2, 2] -= 1.5
    sheets = [np.asarray(contact_sheet(rows, FACTS, metrics, CELSIUS)) for _ in range(2)]
    np.testing.assert_array_equal(*sheets)
    colder = images.renderings[THERMAL] + np.linspace(-1, 0, 24, dtype=np.float32)
    spoiled = replace(images, renderings=images.renderings | {THERMAL: colder})
    other = np.asarray(contact_sheet([(view, spoiled)], FACTS, metrics, CELSIUS))
    assert (sheets[0] != other).any(axis=2).sum() > 1000


def test_rows_hold_celsius_and_mark_invalid_pixels() -> None:
    valid = torch.ones(18, 24, dtype=torch.bool)
    valid[0, 0] = False
    rows, _ = rows_of([ramp_view(valid=valid)], render_with_error, CELSIUS)
    images = rows[0][1]
    assert np.isnan(images.photos[THERMAL][0, 0])
    assert images.photos[THERMAL][8, 10] == pytest.approx(26.0, abs=1e-4)
    assert np.nanmax(np.abs(images.errors[THERMAL] - 1.0)) < 1e-4


def test_without_celsius_the_sheet_says_so() -> None:
    rows, metrics = rows_of([ramp_view()], render_with_error, None)
    sheet = np.asarray(contact_sheet(rows, FACTS, metrics, None))
    with_scale = np.asarray(contact_sheet(rows, FACTS, metrics, TemperatureRange(0.0, 1.0)))
    assert sheet.shape == with_scale.shape
    assert not np.array_equal(sheet[-90:], with_scale[-90:])


def test_all_views_of_one_temperature_can_be_drawn() -> None:
    def perfect(view: View) -> Rendering:
        images = {RGB: view.images[RGB].load().values, THERMAL: torch.full((18, 24, 1), 0.5)}
        return rendering_of(images)

    assert draw([ramp_view(name="x" * 80)], perfect, CELSIUS).shape[0] > CELL_PX // 2


def test_a_third_modality_has_two_columns() -> None:
    two = draw([ramp_view()], render_with_error, CELSIUS)
    three = draw([ramp_view(nir=True)], render_with_error, CELSIUS)
    assert 2 * CELL_PX < three.shape[1] - two.shape[1] < 2 * CELL_PX + 40
    rows, _ = rows_of([ramp_view(nir=True)], render_with_error, CELSIUS)
    assert rows[0][1].photos[NEAR_INFRARED].shape == (20, 16, 3)


def test_views_are_spread_evenly() -> None:
    assert evenly_spaced(3) == [0, 1, 2]
    assert evenly_spaced(9) == [0, 2, 4, 6, 8]
    assert evenly_spaced(100, 4) == [0, 33, 66, 99]
    assert evenly_spaced(1) == [0]
