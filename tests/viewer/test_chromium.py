"""The viewer as its users meet it: driven in headless Chromium, without a graphics card."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mrgs.pictures.palette import palette_table
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Scene
from tests.helpers.browsers import chromium, needs_chromium, new_page, wait_until

pytest.importorskip("viser", reason='the viewer needs viser: pip install "mrgs[view]"')
pytest.importorskip(
    "playwright.sync_api", reason="playwright is not installed: pip install playwright"
)

from playwright.sync_api import Error as BrowserError

from mrgs.viewer.web import Viewer, open_viewer

pytestmark = [needs_chromium, pytest.mark.slow]
CONNECTIONS = 3
"""viser's page hangs up after five seconds without an answer, and starts anew as another client:
where the server gets no processor for so long, the page is opened again."""


@pytest.fixture(scope="module")
def viewer(small_run: Run, balls: Scene) -> Iterator[Viewer]:
    viewer = open_viewer(small_run, balls, "127.0.0.1", 0)
    yield viewer
    viewer.close()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def page(browser: Any, viewer: Viewer) -> Any:
    return open_connected(browser, viewer)


def open_connected(browser: Any, viewer: Viewer) -> Any:
    """A page that is one of the server's clients, with its controls."""
    others = len(viewer.browsers)
    for left in reversed(range(CONNECTIONS)):
        page = new_page(browser, viewport={"width": 900, "height": 600}, reduced_motion="reduce")
        page.foreign = []
        page.on("request", lambda request, page=page: page.foreign.append(request.url))
        try:
            page.goto(viewer.url)
            page.locator(".mrgs-hint").wait_for()
            # It is told that this is software rendering.
            page.locator(".mantine-Notification-closeButton").first.click()
            wait_until(lambda: len(viewer.browsers) == others + 1, "it is connected", page)
            return page
        except (BrowserError, AssertionError):
            page.context.close()
            if not left:
                raise


def choose(page: Any, label: str, option: str) -> None:
    page.get_by_label(label, exact=True).click()
    page.get_by_role("option", name=option, exact=True).click()


def is_drawn(viewer: Viewer) -> bool:
    (browser,) = viewer.browsers
    return browser.inspection.camera is not None and not browser.drawing


def wait_until_sharp(viewer: Viewer, page: Any) -> None:
    """Until nothing is due on the server, and the browser has shown the last picture.

    A note that is sent after the picture is shown after it; a picture that is still decoded then
    shows in the screenshots.
    """
    wait_until(lambda: is_drawn(viewer), "the server has drawn", page)
    (browser,) = viewer.browsers
    wait_until_sharp.notes += 1
    browser.set_note(f"Note {wait_until_sharp.notes}.")
    page.get_by_text(f"Note {wait_until_sharp.notes}.").wait_for(state="attached")
    seen: list[np.ndarray] = []

    def at_rest() -> bool:
        page.wait_for_timeout(300)
        seen.append(screenshot(page))
        return len(seen) > 1 and np.array_equal(seen[-1], seen[-2])

    wait_until(at_rest, "two screenshots in a row are the same", page)


wait_until_sharp.notes = 0


def screenshot(page: Any, path: Path | None = None) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(page.screenshot(path=path))).convert("RGB"))


def test_temperature_is_shown_and_read(viewer, page, small_run, pytestconfig):
    kept = Path(pytestconfig.cache.mkdir("viewer"))  # .pytest_cache/d/viewer
    choose(page, "Show", "Colour")
    wait_until_sharp(viewer, page)
    colour = screenshot(page, kept / "colour.png")
    choose(page, "Show", "Temperature")
    wait_until_sharp(viewer, page)
    before = screenshot(page, kept / "before.png")
    inspection = viewer.browsers[0].inspection
    camera = inspection.camera
    canvas = page.locator("canvas").first.bounding_box()
    x, y = int(canvas["x"] + 0.5 * canvas["width"]), int(canvas["y"] + 0.45 * canvas["height"])
    page.mouse.click(x, y)
    text = page.locator(".mrgs-reading", has_text="°C").inner_text()
    shown = float(re.search(r"(−?\d+\.\d) °C", text).group(1).replace("−", "-"))

    column, row = (
        int((x - canvas["x"]) / canvas["width"] * camera.width),
        int((y - canvas["y"]) / canvas["height"] * camera.height),
    )
    rendered = small_run.temperatures_c(small_run.render(camera))[row, column].item()
    assert shown == pytest.approx(rendered, abs=0.1)

    scale = inspection.scales.values[THERMAL]
    drawn = np.abs(palette_table("inferno").astype(int) - before[y, x]).sum(axis=1).argmin() / 255
    assert scale.low + drawn * (scale.high - scale.low) == pytest.approx(
        shown, abs=0.05 * (scale.high - scale.low)
    )
    assert np.abs(colour[y, x].astype(int) - before[y, x]).max() > 20, "the picture did not change"
    wait_until_sharp(viewer, page)
    after = screenshot(page, kept / "temperature.png")
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
    inspection = viewer.browsers[0].inspection
    wait_until(lambda: inspection.view is balls.train[1], "the second photo is chosen", page)
    expected = balls.train[1].camera.position
    wait_until(
        lambda: np.allclose(inspection.camera.position, expected, atol=1e-3),
        "the view is the photo's",
        page,
    )
    wait_until_sharp(viewer, page)
    np.testing.assert_allclose(inspection.camera.position, expected, atol=1e-3)


def test_nothing_is_fetched_from_elsewhere(page, viewer):
    assert page.foreign
    assert all(url.startswith((viewer.url, "data:", "blob:")) for url in page.foreign)


def test_a_closed_browser_is_forgotten(browser, viewer, page):
    (kept,) = viewer.browsers
    open_connected(browser, viewer).close()
    wait_until(lambda: viewer.browsers == [kept], "the server forgets the browser", page)
