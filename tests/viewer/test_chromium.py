"""The viewer as its users meet it: driven in headless Chromium, without a graphics card."""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mrgs.pictures.palette import palette_table
from mrgs.runs.open import Run
from mrgs.scene import Scene

pytest.importorskip("viser", reason='the viewer needs viser: pip install "mrgs[view]"')
pytest.importorskip(
    "playwright.sync_api", reason="playwright is not installed: pip install playwright"
)

from playwright.sync_api import sync_playwright

from mrgs.viewer.web import Viewer, open_viewer

CHROMIUM = (
    shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium")

FLAGS = [
    "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync",
]  # fmt: skip


@pytest.fixture(scope="module")
def viewer(small_run: Run, balls: Scene) -> Iterator[Viewer]:
    viewer = open_viewer(small_run, balls, "127.0.0.1", 0)
    yield viewer
    viewer.close()


@pytest.fixture(scope="module")
def page(viewer: Viewer) -> Iterator[Any]:
    with sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = chromium.new_page(viewport={"width": 900, "height": 600}, reduced_motion="reduce")
        page.set_default_timeout(20_000)
        page.foreign = []
        page.on("request", lambda request: page.foreign.append(request.url))
        page.goto(viewer.url)
        page.locator(".mrgs-hint").wait_for()
        page.locator(
            ".mantine-Notification-closeButton"
        ).first.click()  # it is told that this is software rendering
        yield page
        chromium.close()


def choose(page: Any, label: str, option: str) -> None:
    page.get_by_label(label, exact=True).click()
    page.get_by_role("option", name=option, exact=True).click()


def wait_until_sharp(viewer: Viewer, page: Any) -> None:
    """Until nothing is due on the server, and the browser has shown the last picture."""
    for _ in range(200):
        page.wait_for_timeout(50)
        (browser,) = viewer.browsers
        if browser.inspection.camera is not None and not browser.drawing:
            break
    page.wait_for_timeout(700)


def test_temperature_is_shown_and_read(viewer, page, small_run, pytestconfig):
    choose(page, "Show", "Colour")
    wait_until_sharp(viewer, page)
    colour = np.asarray(Image.open(shot(page, pytestconfig, "colour")).convert("RGB"))
    choose(page, "Show", "Temperature")
    wait_until_sharp(viewer, page)
    before = np.asarray(Image.open(shot(page, pytestconfig, "before")).convert("RGB"))
    inspection = viewer.browsers[0].inspection
    camera = inspection.camera
    canvas = page.locator("canvas").first.bounding_box()
    x, y = int(canvas["x"] + 0.5 * canvas["width"]), int(canvas["y"] + 0.45 * canvas["height"])
    page.mouse.click(x, y)
    text = page.locator(".mrgs-reading").inner_text()
    shown = float(re.search(r"(−?\d+\.\d) °C", text).group(1).replace("−", "-"))

    column, row = (
        int((x - canvas["x"]) / canvas["width"] * camera.width),
        int((y - canvas["y"]) / canvas["height"] * camera.height),
    )
    rendered = small_run.temperatures_c(small_run.render(camera))[row, column].item()
    assert shown == pytest.approx(rendered, abs=0.1)

    scale = inspection.scales.thermal
    drawn = np.abs(palette_table("inferno").astype(int) - before[y, x]).sum(axis=1).argmin() / 255
    assert scale.low + drawn * (scale.high - scale.low) == pytest.approx(
        shown, abs=0.05 * (scale.high - scale.low)
    )
    assert np.abs(colour[y, x].astype(int) - before[y, x]).max() > 20, "the picture did not change"
    wait_until_sharp(viewer, page)
    after = np.asarray(Image.open(shot(page, pytestconfig, "temperature")).convert("RGB"))
    assert (after[y, x] > 200).all(), "no marker at the point that was read"


def test_a_box_is_drawn_with_the_mouse(viewer, page):
    page.get_by_role("tab", name="Measure").click()
    page.get_by_role("button", name="Draw a box").click()
    page.get_by_text("Now drag over the picture").wait_for()
    canvas = page.locator("canvas").first.bounding_box()
    left, top = canvas["x"] + 0.35 * canvas["width"], canvas["y"] + 0.35 * canvas["height"]
    page.mouse.move(left, top)
    page.mouse.down()
    page.mouse.move(left + 50, top + 50, steps=3)
    page.mouse.move(left + 120, top + 120, steps=3)
    page.mouse.up()
    page.locator(".mrgs-boxes td").first.wait_for()
    cells = page.locator(".mrgs-boxes td").all_inner_texts()
    assert cells[0] == "B1"
    low, mean, high = (float(cell.replace("−", "-")) for cell in cells[1:4])
    assert low < mean < high
    (box,) = viewer.browsers[0].inspection.boxes
    assert (box.u0, box.v0) == pytest.approx((0.35, 0.35), abs=0.01)


def test_a_photo_can_be_gone_to(viewer, page, balls):
    page.get_by_role("tab", name="Photos").click()
    page.get_by_role("button", name="Next photo").click()
    wait_until_sharp(viewer, page)
    inspection = viewer.browsers[0].inspection
    assert inspection.view is balls.train[1]
    np.testing.assert_allclose(
        inspection.camera.position, balls.train[1].rgb.camera.position, atol=1e-3
    )


def test_nothing_is_fetched_from_elsewhere(page, viewer):
    assert page.foreign
    assert all(url.startswith((viewer.url, "data:", "blob:")) for url in page.foreign)


def test_a_closed_browser_is_forgotten(page, viewer):
    page.close()
    for _ in range(100):
        if not viewer.browsers:
            break
        time.sleep(0.05)
    assert viewer.browsers == []


def shot(page: Any, config: pytest.Config, name: str) -> Path:
    """Written where it stays after the test: .pytest_cache/d/viewer/NAME.png."""
    path = Path(config.cache.mkdir("viewer")) / f"{name}.png"
    page.screenshot(path=path)
    return path
