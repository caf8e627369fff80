"""The page in a real browser, from a file, with the network off."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from mrgs.prepare.page.write import write_page
from tests.helpers.browsers import chromium, collect_errors, needs_chromium, new_page

pytestmark = [needs_chromium, pytest.mark.slow]


@pytest.fixture(scope="module")
def page(prepared) -> Iterator[Any]:
    """The page, opened; whatever it reports as an error fails the tests."""
    path = write_page(prepared)
    errors: list[str] = []
    with chromium() as browser:
        page = new_page(browser, offline=True, viewport={"width": 390, "height": 800})
        collect_errors(page, errors, ("file", "data"))
        page.goto(path.as_uri())
        yield page
    assert errors == []


def test_nothing_is_wider_than_a_phone(page):
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


def test_the_thermal_image_is_laid_over_the_photo_in_three_ways(page):
    shown = "getComputedStyle(document.querySelector('.stack .{}')).display"
    assert page.evaluate("document.querySelector('.base').naturalWidth") == 320
    seen = {}
    for name in ("Checkerboard", "Blend", "Thermal outlines"):
        page.get_by_role("button", name=name).click()
        seen[name] = [
            page.evaluate(shown.format(layer)) == "block" for layer in ("warped", "edges")
        ]
    assert seen == {
        "Checkerboard": [True, False],
        "Blend": [True, False],
        "Thermal outlines": [False, True],
    }


def test_two_clicks_and_a_length_give_the_option_in_pixels_of_the_file(page):
    photo = page.locator(".clickable:not([hidden]) img")
    box = photo.bounding_box()
    for x, y in ((0.25, 0.5), (0.75, 0.25)):
        photo.click(position={"x": x * box["width"], "y": y * box["height"]})
    page.fill("#measure-length", "0.85")
    words = page.locator("#measure-option").inner_text().replace("'", "").split()
    assert words[0] == "--known-distance"
    assert words[-1] == "0.85"
    option = page.locator("#measure-option")
    page.fill("#measure-length", "2,4")
    assert option.inner_text().split()[-1] == "2.4"
    for refused in ("", "0", "-1", "2 m"):
        page.fill("#measure-length", refused)
        assert "in metres" in option.inner_text()
    points = [word.rpartition(":")[2].split(",") for word in words if ":" in word]
    pixels = [float(number) for point in points for number in point]
    assert pixels == pytest.approx([80, 120, 240, 60], abs=2)
    page.click("#measure-clear")
    assert "two points" in page.locator("#measure-option").inner_text()


def test_a_camera_in_the_3d_view_leads_to_its_photos(page):
    canvas = page.locator("#orbit-canvas")
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    found = None
    for place in range(int(box["width"] * box["height"]) // 144):
        row, column = divmod(12 * place, int(box["width"]) // 12 * 12)
        page.mouse.move(box["x"] + column, box["y"] + 12 * row)
        if page.locator("#orbit-name").is_visible():
            found = page.locator("#orbit-name").inner_text()
            page.mouse.down()
            page.mouse.up()
            break
    assert found is not None
    assert page.locator(".card.marked").get_attribute("data-view") == found
