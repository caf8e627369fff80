"""The page in a real browser: from a file, with the network off, on software WebGL."""

from __future__ import annotations

import io
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.export.page import packing
from mrgs.export.page.write import PageContent, PageMark, write_page
from mrgs.pictures.drawing import Scale
from mrgs.rasterizer import contract as dilation
from mrgs.rasterizer.contract import Dilation
from mrgs.runs.baked import BakedModel
from mrgs.scene import RGB, THERMAL, Camera, Modality, Rendering
from tests.helpers.browsers import needs_chromium, wait_until
from tests.helpers.gaussians import NEAR_INFRARED
from tests.helpers.packed import as_model, pack, unpack
from tests.helpers.pages import SETTLED, fitted, picture, psnr, read, shown

PIXELS = [
    (0.5, 0.5),
    (0.4, 0.45),
    (0.6, 0.5),
    (0.45, 0.62),
    (0.55, 0.4),
    (0.5, 0.35),
    (0.35, 0.55),
    (0.62, 0.6),
]

pytestmark = [needs_chromium, pytest.mark.slow]


def colours_of_view_3(page: Any, cameras: dict[str, Camera]) -> tuple[np.ndarray, Camera]:
    """The picture of the colours from there, and its camera."""
    page.select_option("#camera", "view 3")
    colours = shown(page, "rgb")
    height, width = colours.shape[:2]
    return colours, fitted(cameras["view 3"], width, height)


def bytes_of(rendering: Rendering) -> np.ndarray:
    """The colours as a picture has them."""
    return 255 * rendering[RGB].image.clamp(0, 1).numpy()


def reaching_the_plane_of(camera: Camera, baked: BakedModel) -> BakedModel:
    """The splats, of which the first two now lie before the camera: the first reaches the plane of
    the camera, the second not quite."""
    model = replace(baked, means=baked.means.clone(), scales=baked.scales.clone())
    model.means[:2] = (camera.position + camera.viewmat[2, :3]).float()
    model.scales[0], model.scales[1] = 1.02, 0.98
    for opacities in model.opacities.values():
        opacities[:2] = 0.3
    return model


def test_the_page_shows_and_tells_what_the_model_renders(open_page, baked, cameras, tmp_path):
    baked = reaching_the_plane_of(cameras["view 3"], baked)
    page = open_page(baked, viewport={"width": 800, "height": 420})
    colours, camera = colours_of_view_3(page, cameras)
    height, width = colours.shape[:2]
    expected = baked.render(camera, THERMAL)
    assert psnr(colours, bytes_of(expected)) > 45

    heat = shown(page, "thermal")
    celsius = baked.temperature.to_celsius(expected[THERMAL].image[..., 0]).numpy()
    seen = expected[THERMAL].alpha.numpy() >= 0.5
    assert psnr(heat[seen], Scale("inferno", 0.0, 80.0, "").colorize(celsius)[seen]) > 40

    depth = expected.surface_depth(THERMAL).numpy()
    for x, y in [(int(share_x * width), int(share_y * height)) for share_x, share_y in PIXELS]:
        assert seen[y, x]
        told_c, told_depth = read(page, x, y)
        assert told_c == pytest.approx(celsius[y, x], abs=0.2)
        assert told_depth == pytest.approx(depth[y, x], abs=0.01)
    page.screenshot(path=Path(os.environ.get("MRGS_SCREENSHOTS", tmp_path)) / "export_page.png")


@pytest.mark.parametrize("least_px2", [0.01, 150.0])
def test_a_picture_coarser_than_the_photos_is_dilated_less(
    open_page, baked, cameras, monkeypatch, least_px2
):
    for module in (dilation, packing):
        monkeypatch.setattr(module, "LEAST_DILATION_PX2", least_px2)
    baked = replace(baked, dilation=Dilation(300.0, finest_focal_px=1_000.0))
    page = open_page(baked, viewport={"width": 320, "height": 200})
    colours, camera = colours_of_view_3(page, cameras)
    height, width = colours.shape[:2]
    expected, *others = (
        replace(baked, dilation=each).render(camera, THERMAL)
        for each in (baked.dilation, Dilation(300.0), Dilation(0.3))
    )
    assert psnr(colours, bytes_of(expected)) > 45
    for other in others:
        assert psnr(colours, bytes_of(other)) < 30

    page.click("[data-modality=thermal]")
    page.wait_for_selector(SETTLED)
    x, y = width // 2, height // 2
    told_c, told_depth = read(page, x, y)
    celsius, depth = reading_at(expected, baked, x, y)
    assert (told_c, told_depth) == (
        pytest.approx(celsius, abs=0.2),
        pytest.approx(depth, abs=0.01),
    )
    for other in others:
        assert abs(reading_at(other, baked, x, y)[0] - celsius) > 0.4


def test_needles_keep_their_shape(open_page, baked, cameras):
    """Thousands of times as long as wide: a covariance in single precision would not have it (36
    dB here). What is left comes from the corners, which WebGL rounds to 1/256 pixel."""
    scales = baked.scales * torch.tensor([20.0, 1e-3, 1e-3])
    needles = replace(baked, scales=scales, dilation=Dilation(0.01))
    needles = as_model(unpack(pack(needles)), needles)
    page = open_page(needles, viewport={"width": 800, "height": 420})
    colours, camera = colours_of_view_3(page, cameras)
    assert psnr(colours, bytes_of(needles.render(camera))) > 39


def reading_at(rendering: Rendering, baked: BakedModel, x: int, y: int) -> tuple[float, float]:
    """What the page ought to tell of a pixel: °C and depth."""
    celsius = baked.temperature.to_celsius(rendering[THERMAL].image[y, x, 0])
    return float(celsius), float(rendering.surface_depth(THERMAL)[y, x])


def test_a_page_in_parts_ends_with_the_picture_of_a_whole_one(open_page):
    window = {"width": 800, "height": 420}
    whole = open_page(viewport=window)
    expected, reading = shown(whole, "rgb"), read(whole, 300, 200)
    page = open_page(part_size=150, viewport=window)
    assert psnr(shown(page, "rgb"), expected) > 40
    assert read(page, 300, 200) == pytest.approx(reading, rel=0.01)
    assert page.locator("#progress").is_hidden()


def test_a_page_that_breaks_off_says_so(open_page, baked, cameras, tmp_path):
    path = tmp_path / "cut.html"
    write_page(baked, cameras, "t", path, PageContent(part_size=150))
    text = path.read_text(encoding="utf-8")
    path.write_text(text[: text.rindex('<script type="application/json" class="part">')])
    page = open_page()
    page.goto(path.as_uri())
    message = page.wait_for_selector("#status:text('A part of this file is missing')")
    page.set_viewport_size({"width": 700, "height": 500})
    page.wait_for_timeout(1_000)  # so that what is there is drawn anew
    assert message.is_visible()


def test_a_third_modality_is_shown_and_read(open_page, with_nir, cameras, tmp_path):
    page = open_page(
        with_nir, modalities=with_nir.modalities, viewport={"width": 800, "height": 420}
    )
    page.select_option("#camera", "view 3")
    grey = shown(page, "nir")
    height, width = grey.shape[:2]
    expected = with_nir.render(fitted(cameras["view 3"], width, height), NEAR_INFRARED)
    _, _, alpha = expected[NEAR_INFRARED]
    values = expected[NEAR_INFRARED].image[..., 0].numpy()
    assert psnr(grey, 255 * values.clip(0, 1)[..., None]) > 40
    depth = expected.surface_depth(NEAR_INFRARED).numpy()
    for x, y in [(int(share_x * width), int(share_y * height)) for share_x, share_y in PIXELS]:
        assert alpha[y, x] >= 0.5
        assert read(page, x, y) == pytest.approx((values[y, x], depth[y, x]), abs=0.01)
    assert page.locator("#reading-of").inner_text() == ": Near infrared"
    assert "°C" not in page.locator("#value").inner_text()
    page.screenshot(path=Path(os.environ.get("MRGS_SCREENSHOTS", tmp_path)) / "page_nir.png")
    assert psnr(shown(page, "thermal"), grey) < 25
    read(page, width // 2, height // 2)
    assert "°C" in page.locator("#value").inner_text()


def test_a_third_modality_with_a_unit_has_a_scale_of_its_own(open_page, with_nir):
    metric = replace(NEAR_INFRARED, unit="W/m²")

    def named(values: dict[Modality, Any]) -> dict[Modality, Any]:
        return {metric if each == metric else each: value for each, value in values.items()}

    model = replace(
        with_nir,
        opacities=named(with_nir.opacities),
        sh_dc=named(with_nir.sh_dc),
        sh_rest=named(with_nir.sh_rest),
    )
    page = open_page(model, modalities=model.modalities, viewport={"width": 800, "height": 420})
    title, high = page.locator("#scale-title"), page.locator("#high")
    assert (title.inner_text(), high.input_value()) == ("Temperature scale, °C", "80.0")
    page.click("[data-modality=nir]")
    page.wait_for_selector(SETTLED)
    assert title.inner_text().startswith("Near infrared")
    assert title.inner_text().endswith("W/m²")
    assert float(high.input_value()) < 3
    assert np.ptp(picture(page), axis=2).mean() > 20, "it is not drawn through the palette"
    page.click("[data-modality=rgb]")
    page.click("[data-modality=thermal]")
    assert (title.inner_text(), high.input_value()) == ("Temperature scale, °C", "80.0")


def test_palette_range_and_isotherm_change_the_picture(open_page):
    page = open_page(viewport={"width": 800, "height": 420})
    page.click("[data-modality=thermal]")
    page.wait_for_selector(SETTLED)
    page.select_option("#palette", "grey")
    page.wait_for_selector(SETTLED)
    grey = picture(page)
    assert np.ptp(grey, axis=2).mean() < 5
    page.fill("#high", "160,0")
    page.press("#high", "Enter")
    page.wait_for_selector(SETTLED)
    assert picture(page).mean() < 0.7 * grey.mean()
    page.select_option("#isotherm", "between")
    page.fill("#isotherm-low", "30")
    page.press("#isotherm-low", "Enter")
    page.wait_for_selector(SETTLED)
    red, green, _ = np.moveaxis(picture(page), 2, 0)
    assert 0.02 < (green - red > 100).mean() < 0.9


def mark(kind: str, points: list[list[float]], **more: Any) -> PageMark:
    name = kind[0].upper() + "1"
    return {
        "name": name, "kind": kind, "value": "21.0 °C", "difference": "", "lines": ["1.00 m"],
        "profile": [], "ends": [], "note": "", "area": False, "emissivity": None,
        "reflected_c": None, "reference": False, "points": points, "closed": kind == "box",
        "lowAt": None, "highAt": None, "label": f"{name}  21.0 °C", **more,
    }  # fmt: skip


def test_marks_are_listed_drawn_and_hidden_behind_surfaces(open_page):
    ends = ["20.0 °C", "22.0 °C", "1.00 m"]
    profile = [(0.0, 20.0), (1.0, 22.0)]
    marks = [
        mark("spot", [[0.0, 0.0, 2.0]]),
        mark("line", [[0.0, -0.5, 2.0], [0.0, 0.5, 2.0]], profile=profile, ends=ends),
        mark("box", [[-9.0, 0.0, -0.5], [-9.0, 1.0, -0.5], [-9.0, 1.0, 0.5], [-9.0, 0.0, 0.5]]),
    ]
    page = open_page(marks=marks, viewport={"width": 800, "height": 600})
    page.wait_for_selector(SETTLED)
    rows = page.locator("#mark-list details")
    assert rows.count() == 3
    rows.nth(1).locator("summary").click()
    assert rows.nth(1).locator("svg path").count() == 1
    texts = rows.nth(1).locator("svg text").all_text_contents()
    assert texts == [*ends[:2], "0", ends[2]]
    left = "texts => Math.min(...texts.map((text) => text.getBBox().x))"
    assert rows.nth(1).locator("svg text").evaluate_all(left) >= 0, "the unit is cut off"
    drawn = page.locator("#marks path.over")
    wait_until(lambda: drawn.count() == 2, "the box behind the splats is hidden", page)
    page.uncheck("#show-marks")
    assert drawn.count() == 0


def test_a_long_list_of_marks_scrolls_beside_the_picture(open_page):
    box = mark("box", [[0.0, 0.0, 2.0]] * 4, lines=["1.00 m", "ε 0.5"])
    page = open_page(marks=[box] * 30, viewport={"width": 800, "height": 600})
    first = page.locator("#mark-list details").first
    first.locator("summary").press("Enter")
    assert "ε 0.5" in first.inner_text()
    assert page.evaluate("document.documentElement.scrollHeight <= window.innerHeight")


def test_keys_turn_the_view_and_read_its_middle(open_page):
    page = open_page(viewport={"width": 800, "height": 600})
    view = page.get_by_role("application", name="3D view")
    view.press("Enter")
    page.wait_for_selector("#spot-list span:text-matches('°C')")
    middle = page.locator("#value").inner_text()
    for _ in range(8):
        view.press("ArrowLeft")
    view.press("Enter")
    wait_until(lambda: page.locator("#value").inner_text() != middle, "the view turned", page)


def test_orbit_zoom_and_the_way_back(open_page):
    page = open_page(viewport={"width": 800, "height": 420})
    page.click("[data-modality=rgb]")
    page.wait_for_selector(SETTLED)
    start = picture(page)
    box = page.locator("#view").bounding_box()
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 80, middle[1] + 20, steps=4)
    page.mouse.up()
    page.wait_for_selector(SETTLED)
    turned = picture(page)
    assert psnr(turned, start) < 30
    page.mouse.wheel(0, 400)
    wait_until(lambda: not np.array_equal(picture(page), turned), "the wheel is felt", page)
    page.wait_for_selector(SETTLED)
    assert (picture(page).sum(axis=2) > 30).mean() < 0.8 * (turned.sum(axis=2) > 30).mean()
    page.click("#home")
    page.wait_for_selector(SETTLED)
    assert np.abs(picture(page) - start).max() <= 1


def test_it_opens_on_temperatures_with_round_ticks_over_the_picture(open_page):
    page = open_page(viewport={"width": 800, "height": 600})
    assert page.locator("[data-modality=thermal]").get_attribute("aria-pressed") == "true"
    ticks = page.locator(".scale span").all_inner_texts()
    assert ticks == ["0", "20", "40", "60", "80 °C"]
    page.click("[data-modality=rgb]")
    assert page.locator(".scale").count() == 0


def test_the_scale_is_locked_and_fits_the_view_when_asked(open_page, baked, cameras):
    page = open_page(viewport={"width": 800, "height": 600})

    def limits() -> tuple[float, float]:
        texts = (page.locator(name).input_value() for name in ("#low", "#high"))
        return tuple(float(text.replace("−", "-")) for text in texts)

    page.select_option("#camera", "view 3")
    page.wait_for_selector(SETTLED)
    assert limits() == (0, 80)
    page.click("#fit")
    low, high = limits()
    box = page.locator("#view").bounding_box()
    camera = fitted(cameras["view 3"], round(box["width"]), round(box["height"]))
    blend = baked.render({THERMAL: camera})[THERMAL]
    seen = baked.temperature.to_celsius(blend.image[..., 0][blend.alpha >= 0.5]).numpy()
    coldest, hottest = np.percentile(seen, [0.5, 99.5])
    assert coldest - 6 < low < coldest + 1
    assert hottest - 1 < high < hottest + 6
    assert (low, high) != (0, 80)


@pytest.mark.parametrize(("width", "height"), [(390, 844), (800, 600), (1440, 900)])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_the_window(open_page, width, height, scheme, tmp_path):
    phone = width < 500
    page = open_page(
        viewport={"width": width, "height": height},
        color_scheme=scheme,
        has_touch=phone,
        is_mobile=phone,
    )
    path = Path(os.environ.get("MRGS_SCREENSHOTS", tmp_path)) / f"page_{width}_{scheme}.png"
    image = np.asarray(Image.open(io.BytesIO(page.screenshot(path=path))).convert("RGB"))
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    for selector in ("#home", ".scale"):
        place = page.locator(selector).bounding_box()
        assert 0 <= place["x"] <= place["x"] + place["width"] <= width
        assert 0 <= place["y"] <= place["y"] + place["height"] <= height
    assert (image[10, width - 10].mean() < 80) == (scheme == "dark")


def test_a_tap_on_a_phone_reads_a_temperature(open_page):
    page = open_page(viewport={"width": 390, "height": 800}, has_touch=True, is_mobile=True)
    box = page.locator("#view").bounding_box()
    page.touchscreen.tap(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.wait_for_selector("#spot-list span:text-matches('°C')")
    told = page.locator("#spot-list span").first.inner_text()
    assert page.locator("#value").inner_text() == told
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


def test_a_page_of_one_modality_shows_that_alone(open_page):
    thermal = open_page(modalities=(THERMAL,), viewport={"width": 800, "height": 420})
    assert not thermal.locator("[data-modality=rgb]").is_visible()
    assert thermal.locator("#value").is_visible()
    colour = open_page(modalities=(RGB,), viewport={"width": 800, "height": 420})
    assert not any(
        colour.locator(name).is_visible()
        for name in ("[data-modality=thermal]", "#value", "#palette")
    )
    assert psnr(picture(colour), picture(thermal)) < 20
    colour.mouse.click(200, 200)
    assert not colour.locator("#spots").is_visible()
