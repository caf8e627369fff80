"""The page's areas with an emissivity of their own, against the marks' own correction."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mrgs.export.page.write import PageContent, write_page
from mrgs.marks import Mark, Marks
from mrgs.marks.emissivity import CaptureSettings, SurfaceSettings
from mrgs.marks.measure import MarkMeter
from mrgs.marks.regions import Regions
from mrgs.pictures.drawing import Scale
from mrgs.rasterizer.contract import Dilation
from mrgs.runs.baked import BakedModel
from mrgs.scene import RGB, THERMAL, Camera, Rendering, TemperatureRange
from mrgs.scene.radiometry import Planck
from tests.helpers.browsers import needs_chromium, new_page
from tests.helpers.pages import SETTLED, fitted, picture, psnr, read

pytestmark = [needs_chromium, pytest.mark.slow]

WINDOW = {"width": 800, "height": 420}
CAPTURE = CaptureSettings(
    SurfaceSettings(0.95, 20.0), Planck(15000.0, 0.0125, 1400.0, 1.0, -6000.0)
)
ON_TABLE = Mark(
    "B1", "box", ((-0.8, -0.8, 0.0), (0.4, -0.8, 0.0), (0.4, 0.3, 0.0), (-0.8, 0.3, 0.0)),
    (0.0, -0.8, 2.4), emissivity=0.4, reflected_c=5.0,
)  # fmt: skip
ON_BALL = Mark(
    "B2", "box", ((-0.3, -0.2, 0.1), (0.0, -0.3, 0.1), (0.0, -0.3, 0.4), (-0.3, -0.2, 0.4)),
    (-0.7, -1.0, 0.4), emissivity=0.7, reflected_c=10.0,
)  # fmt: skip
SPOT = Mark("S1", "spot", ((-0.45, -0.45, 0.0),), (0.0, -0.8, 2.4), radius=0.03)


@pytest.fixture(scope="module")
def table() -> BakedModel:
    """A table 2 wide at z = 0, from 4 °C on its left to 46 °C, with a ball of 18 °C on it."""
    side = torch.linspace(-1, 1, 60)
    across, along = torch.meshgrid(side, side, indexing="ij")
    flat = torch.stack([across, along, torch.zeros_like(across)], dim=-1).reshape(-1, 3)
    index = torch.arange(2000) + 0.5
    polar, around = torch.acos(1 - 2 * index / 2000), torch.pi * (1 + 5**0.5) * index
    ring = polar.sin()
    ball = 0.25 * torch.stack([ring * around.cos(), ring * around.sin(), polar.cos() + 1], dim=1)
    means = torch.cat([flat, ball])
    scales = torch.cat(
        [torch.tensor([[0.024, 0.024, 0.002]]).repeat(3600, 1), torch.full((2000, 3), 0.012)]
    )
    temperatures = torch.cat([0.5 + 0.3 * flat[:, 0], torch.full((2000,), 0.4)])
    sh = torch.zeros(5600, 1, 3)
    return BakedModel(
        means, torch.tensor([1.0, 0, 0, 0]).repeat(5600, 1), scales,
        dict.fromkeys((RGB, THERMAL), torch.full((5600,), 0.95)), {RGB: sh}, {RGB: sh[:, :0]},
        temperatures, TemperatureRange(-10.0, 60.0), dilation=Dilation(0.1, 107.0),
    )  # fmt: skip


@pytest.fixture(scope="module")
def regions(table: BakedModel) -> Regions:
    found = Regions(Marks((ON_TABLE, ON_BALL)), partial(seen, table), table.temperature, CAPTURE)
    assert [region.plane is not None for region in found] == [True, False]
    return found


def seen(table: BakedModel, camera: Camera) -> Rendering:
    return table.render(camera, THERMAL)


def celsius(table: BakedModel, rendering: Rendering) -> np.ndarray:
    return table.temperature.to_celsius(rendering[THERMAL].image[..., 0]).numpy()


@pytest.fixture
def opened(open_page, table, regions, cameras) -> tuple[Any, Camera]:
    """The page from the side of the ball, and the camera of its picture."""
    page = open_page(table, regions=regions, viewport=WINDOW)
    page.select_option("#camera", "view 3")
    page.wait_for_selector(SETTLED)
    height, width = picture(page).shape[:2]
    return page, fitted(cameras["view 3"], width, height)


def test_the_picture_shows_what_is_corrected_and_the_cursor_reads_it(
    opened, table, regions, tmp_path
):
    page, camera = opened
    plain = seen(table, camera)
    before, after = (celsius(table, each) for each in (plain, regions.applied_to(plain, camera)))
    solid = plain[THERMAL].alpha.numpy() >= 0.5
    own = solid & (after != before)
    assert 0.2 < own.sum() / solid.sum() < 0.8
    heat = picture(page)
    assert psnr(heat[own], Scale("inferno", 0.0, 80.0, "").colorize(after)[own]) > 30
    assert psnr(heat[own], Scale("inferno", 0.0, 80.0, "").colorize(before)[own]) < 20
    off = np.abs(heat - Scale("inferno", 0.0, 80.0, "").colorize(after)).max(axis=2) > 12
    assert off[solid].mean() < 0.02

    edges = solid & (own ^ np.roll(own, 2, axis=1))
    for part, fewest in ((own, 1.0), (solid & ~own, 1.0), (edges, 0.8)):
        rows, columns = np.nonzero(part)
        step = len(rows) // 15
        told = [read(page, x, y)[0] for y, x in zip(rows[::step], columns[::step], strict=True)]
        assert (np.abs(told - after[part][::step]) < 0.3).mean() >= fewest
    page.screenshot(path=Path(os.environ.get("MRGS_SCREENSHOTS", tmp_path)) / "page_areas.png")


def test_the_cursor_reads_what_a_mark_measures_there(opened, table, regions):
    page, camera = opened
    meter = MarkMeter(partial(seen, table), table.temperature, capture=CAPTURE)
    reading = meter.read(SPOT, regions)
    pixel, _ = camera.project(torch.tensor(SPOT.points[0], dtype=torch.float64))
    told, _ = read(page, *pixel.int().tolist())
    assert told == pytest.approx(reading.mean, abs=2.0), "a pixel away it is 1 K colder"
    assert meter.read(SPOT).mean < reading.mean - 10


def test_scale_and_isotherm_follow_what_is_corrected(opened, table, regions):
    page, camera = opened
    rendering = regions.applied_to(seen(table, camera), camera)
    shown = celsius(table, rendering)[rendering[THERMAL].alpha.numpy() >= 0.5]
    page.click("#fit")
    texts = [page.locator(name).input_value() for name in ("#low", "#high")]
    low, high = (float(text.replace("−", "-")) for text in texts)
    coldest, hottest = np.percentile(shown, [0.5, 99.5])
    assert coldest - 6 < low < coldest + 1
    assert hottest - 1 < high < hottest + 6
    page.select_option("#isotherm", "above")
    page.fill("#isotherm-low", "40")
    page.press("#isotherm-low", "Enter")
    page.wait_for_selector(SETTLED)
    red, green, blue = np.moveaxis(picture(page), 2, 0)
    above = (np.abs(red - 51) < 2) & (np.abs(green - 242) < 2) & (np.abs(blue - 89) < 2)
    assert above.sum() == pytest.approx((shown > 40).sum(), rel=0.02)


def test_only_what_the_photos_have_at_the_end_of_their_range_is_doubted(opened, table, regions):
    page, camera = opened
    rendering = regions.applied_to(seen(table, camera), camera)
    after = np.where(rendering[THERMAL].alpha >= 0.5, celsius(table, rendering), 0.0)
    y, x = np.unravel_index(after.argmax(), after.shape)
    told, _ = read(page, int(x), int(y))
    assert told > table.temperature.max_c
    assert page.locator("#clipped").is_hidden()
    assert page.locator("#uncorrected").is_hidden()
    assert "Marked areas" in page.locator("aside").inner_text()


def test_a_browser_without_images_of_floats_says_so_and_reads_corrected_values(
    browser, table, regions, cameras, tmp_path
):
    path = write_page(table, cameras, "t", tmp_path / "page.html", PageContent(regions=regions))
    page = new_page(browser, viewport=WINDOW)
    page.add_init_script("WebGL2RenderingContext.prototype.getExtension = () => null;")
    page.goto(path.as_uri())
    page.wait_for_selector(SETTLED)
    page.select_option("#camera", "view 3")
    page.wait_for_selector(SETTLED)
    height, width = picture(page).shape[:2]
    camera = fitted(cameras["view 3"], width, height)
    rendering = regions.applied_to(seen(table, camera), camera)
    after = np.where(rendering[THERMAL].alpha >= 0.5, celsius(table, rendering), 0.0)
    y, x = np.unravel_index(after.argmax(), after.shape)
    assert read(page, int(x), int(y))[0] == pytest.approx(after[y, x], abs=0.5)
    assert page.locator("#uncorrected").is_visible()
    page.context.close()
