"""The reader's spots, what the browser keeps of a page, photos, and pictures for files."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mrgs.export.page.write import PageContent, write_page
from mrgs.marks.run_marks import spot_radius
from mrgs.pictures.html import inline_image
from mrgs.scene import THERMAL
from tests.helpers.browsers import collect_errors, needs_chromium, new_page, wait_until
from tests.helpers.pages import SETTLED, fitted, read

pytestmark = [needs_chromium, pytest.mark.slow]

WINDOW = {"width": 900, "height": 600}


def place_spots(page: Any, *shares: tuple[float, float]) -> None:
    """Click at places of the picture, from 0 to 1, that show the model."""
    rows, box = page.locator("#spot-list > div"), page.locator("#view").bounding_box()
    for across, down in shares:
        count = rows.count()
        page.mouse.click(box["x"] + across * box["width"], box["y"] + down * box["height"])
        wait_until(lambda before=count: rows.count() == before + 1, "the spot is listed", page)


def rows_of(page: Any) -> list[list[str]]:
    """Name, value and difference of each spot."""
    found = page.locator("#spot-list > div").all()
    return [row.locator("button, span").all_inner_texts()[:3] for row in found]


def celsius(text: str) -> float:
    return float(re.search(r"[−\d.]+", text)[0].replace("−", "-"))


def test_spots_are_listed_with_their_differences_and_drawn(open_page):
    page = open_page(viewport=WINDOW)
    assert not page.locator("#spots").is_visible()
    place_spots(page, (0.5, 0.5), (0.45, 0.4), (0.55, 0.6))
    rows = rows_of(page)
    assert [name for name, _, _ in rows] == ["P1", "P2", "P3"]
    assert rows[0][2] == "reference"
    for _, value, difference in rows[1:]:
        assert re.fullmatch(r"ΔT [+−]?\d+\.\d K", difference)
        assert celsius(difference) == pytest.approx(celsius(value) - celsius(rows[0][1]), abs=0.11)
    wait_until(lambda: page.locator("#marks path.over").count() == 3, "they are drawn", page)
    page.get_by_role("button", name="P3", exact=True).click()
    assert rows_of(page)[2][2] == "reference"
    page.get_by_role("button", name="Delete P3").click()
    assert rows_of(page)[0][2] == "reference"
    place_spots(page, (0.5, 0.55))
    assert [row[0] for row in rows_of(page)] == ["P1", "P2", "P3"]
    page.click("#clear-spots")
    assert not page.locator("#spots").is_visible()


def test_a_spot_is_as_wide_as_the_programs(open_page, baked, cameras):
    first = next(iter(cameras.values()))
    # Two photos show the middle, and one beside it looks the other way.
    behind = first.position + (first.position - first.viewmat[2, :3])
    away = first.with_width(640).look_at(first.position, behind)
    thermal = [first.with_width(24), first.with_width(16), away]
    page = open_page(viewport=WINDOW, thermal_cameras=thermal)
    width, height = page.locator("#view").evaluate("view => [view.width, view.height]")
    camera = fitted(first, width, height)
    rendering = baked.render({THERMAL: camera}, surface=THERMAL)
    celsius = baked.temperature.to_celsius(rendering[THERMAL].image[..., 0]).numpy()
    depth = rendering.visible_depth().numpy()
    scene = SimpleNamespace(train_photos=lambda _: [SimpleNamespace(camera=c) for c in thermal])
    changes = 0
    for x, y in ((width // 2, height // 2), (width // 2 + 25, height // 2 - 30)):
        place = camera.unproject([x + 0.5, y + 0.5], float(depth[y, x]))
        radius = spot_radius(tuple(place.tolist()), camera, scene)
        reach = radius * float(camera.K[0, 0]) / depth[y, x]
        turns = np.arange(8) * np.pi / 4
        columns = np.floor(x + 0.5 + reach * np.sqrt(0.5) * np.cos(turns)).astype(int)
        rows = np.floor(y + 0.5 + reach * np.sqrt(0.5) * np.sin(turns)).astype(int)
        same = np.abs(depth[rows, columns] - depth[y, x]) < 0.03 * depth[y, x]
        expected = np.mean([celsius[y, x], *celsius[rows, columns][same]])
        value, _ = read(page, x, y)
        assert value == pytest.approx(float(expected), abs=0.05)
        changes += abs(value - celsius[y, x]) > 0.5
    assert changes


def test_no_click_is_lost_while_the_pointer_moves_on(open_page):
    page = open_page(viewport=WINDOW)
    box = page.locator("#view").bounding_box()
    page.evaluate(
        """() => {
            const view = document.getElementById("view");
            const send = (type, x, y) => view.dispatchEvent(new PointerEvent(type, {
                clientX: x, clientY: y, button: 0, pointerId: 1, bubbles: true }));
            view.setPointerCapture = () => {};
            const { left, top, width, height } = view.getBoundingClientRect();
            for (let n = 0; n < 5; n++) {
                const at = [left + width * (0.45 + 0.02 * n), top + height / 2];
                for (const type of ["pointermove", "pointerdown", "pointerup"]) send(type, ...at);
                send("pointermove", at[0] + 1, at[1]);
            }
        }"""
    )
    wait_until(lambda: len(rows_of(page)) == 5, "all spots are there", page)
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    for button in ("right", "middle"):  # which move the view
        page.mouse.down(button=button)
        page.mouse.up(button=button)
    place_spots(page, (0.5, 0.6))
    assert len(rows_of(page)) == 6


def test_the_keyboard_stays_at_the_spot_that_others_are_compared_with(open_page):
    page = open_page(viewport=WINDOW)
    place_spots(page, (0.5, 0.5), (0.45, 0.4))
    page.get_by_role("button", name="P2", exact=True).press("Enter")
    assert page.evaluate("document.activeElement.textContent") == "P2"


def test_spots_palette_and_range_outlast_a_reload(open_page):
    page = open_page(viewport=WINDOW)
    place_spots(page, (0.5, 0.5), (0.45, 0.4))
    page.get_by_role("button", name="P2", exact=True).click()
    page.select_option("#palette", "iron")
    for end, text in (("low", "15"), ("high", "45")):
        page.fill(f"#{end}", text)
        page.press(f"#{end}", "Enter")
    before = rows_of(page)
    page.reload()
    page.wait_for_selector(SETTLED)
    assert rows_of(page) == before
    kept = [page.input_value(f"#{name}") for name in ("palette", "low", "high")]
    assert kept == ["iron", "15.0", "45.0"]


def test_what_else_is_kept_under_its_name_is_ignored(open_page):
    page = open_page(viewport=WINDOW)
    place_spots(page, (0.5, 0.5))
    (key,) = page.evaluate("Object.keys(localStorage)")
    for kept in (
        "no", "7", "[]", "null", '{"spots": "abc", "palette": 7, "ranges": 3}',
        '{"spots": [null, {"name": "P1"}]}',
        '{"spots": [{"name": "P2", "modality": "toString", "point": [1, 2, 3], "value": 1}]}',
        '{"palette": "toString", "ranges": {"thermal": ["a", "b"]}}',
    ):  # fmt: skip
        page.evaluate("([key, kept]) => localStorage.setItem(key, kept)", [key, kept])
        page.reload()
        page.wait_for_selector(SETTLED)
        assert rows_of(page) == []
        assert page.input_value("#palette") == "inferno"
    place_spots(page, (0.5, 0.5))


def test_what_is_kept_belongs_to_its_page(open_page, with_nir):
    place_spots(open_page(viewport=WINDOW), (0.5, 0.5))
    assert rows_of(open_page(with_nir, viewport=WINDOW)) == []


def test_a_browser_that_keeps_nothing_shows_the_page_all_the_same(open_page):
    page = open_page(viewport=WINDOW)
    page.add_init_script(
        "Object.defineProperty(window, 'localStorage', { get() { throw new Error('no'); } });"
    )
    page.reload()
    page.wait_for_selector(SETTLED)
    place_spots(page, (0.5, 0.5))


def test_a_saved_picture_has_the_model_the_spots_and_the_scale(open_page, tmp_path):
    page = open_page(viewport=WINDOW)
    with page.expect_download() as bare:
        page.click("#save")
    place_spots(page, (0.5, 0.5))
    page.wait_for_selector(SETTLED)
    with page.expect_download() as marked:
        page.click("#save")
    pictures = []
    for number, download in enumerate((bare, marked)):
        path = tmp_path / f"{number}.png"
        download.value.save_as(path)
        pictures.append(np.asarray(Image.open(path).convert("RGB"), dtype=int))
    assert marked.value.suggested_filename == "Synthetic splats view 0.png"
    size = page.locator("#view").evaluate("canvas => [canvas.height, canvas.width]")
    assert list(pictures[0].shape[:2]) == size
    card = page.locator(".scale").bounding_box()
    view = page.locator("#view").bounding_box()
    left, top = round(card["x"] - view["x"]), round(card["y"] - view["y"])
    assert (pictures[0][top + 3, left + 3] > 230).all(), "the card of the scale"
    changed = (pictures[0] != pictures[1]).any(axis=2)
    rows, columns = np.nonzero(changed)
    assert 60 < len(rows) < 6000
    assert abs(rows.mean() - size[0] / 2) < 40
    assert columns.min() > size[1] / 2 - 15


def test_the_photo_of_the_view_is_shown_and_enlarged(browser, baked, cameras, tmp_path):
    photos = {
        name: inline_image(Image.new("RGB", (60, 40), (40 * number, 90, 20)), name, png=True)
        for number, name in enumerate(cameras)
        if name != "view 2"
    }
    path = Path(tmp_path) / "page.html"
    write_page(baked, cameras, "t", path, PageContent(photos=photos))
    page, errors = new_page(browser, offline=True, viewport=WINDOW), []
    collect_errors(page, errors, ("file", "blob", "data"))
    page.goto(path.as_uri())
    page.wait_for_selector(SETTLED)
    shown = page.locator("#photo")
    for name in ("view 0", "view 3"):
        page.select_option("#camera", name)
        assert shown.locator("img").get_attribute("src") == photos[name].source
    page.select_option("#camera", "view 2")
    assert not shown.is_visible()
    page.select_option("#camera", "view 1")
    shown.click()
    large = page.locator("#photo-large")
    assert large.is_visible()
    page.keyboard.press("Escape")
    assert not large.is_visible()
    shown.press("Enter")
    assert large.is_visible()
    page.context.close()
    assert errors == []
