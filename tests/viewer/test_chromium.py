"""The viewer as its users meet it: driven in headless Chromium, without a graphics card."""

from __future__ import annotations

import base64
import io
import os
import re
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mrgs.marks.store import MarkStore
from mrgs.pictures.page_data import PALETTE_CHOICES
from mrgs.pictures.palette import palette_table
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Scene
from mrgs.survey import SURVEY_FILE, read_survey
from mrgs.viewer.board import MarkBoard
from mrgs.viewer.painting import NO_SURFACE_COLOR
from mrgs.viewer.server import open_viewer
from mrgs.viewer.web import Viewer
from tests.helpers.browsers import chromium, needs_chromium, new_page, wait_until

pytestmark = [needs_chromium, pytest.mark.slow]

SETTLED = "#view[data-settled=true]"


@pytest.fixture(scope="module")
def viewer(small_run: Run, balls: Scene) -> Iterator[Viewer]:
    viewer = open_viewer(small_run, balls, "127.0.0.1", 0)
    yield viewer
    viewer.close()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


@pytest.fixture
def open_page(browser: Any, viewer: Viewer) -> Iterator[Any]:
    """Opens the page; whatever it reports as an error, or fetches elsewhere, fails the test."""
    errors: list[str] = []
    contexts = []

    def open_it(**options: Any) -> Any:
        page = new_page(browser, **{"viewport": {"width": 900, "height": 600}, **options})
        contexts.append(page.context)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
        own = (f"http://127.0.0.1:{viewer.port}/", "blob:", "data:")
        page.on("request", lambda r: None if r.url.startswith(own) else errors.append(r.url))
        page.goto(viewer.url)
        page.wait_for_selector(SETTLED)
        return page

    yield open_it
    for context in contexts:
        context.close()
    wait_until(lambda: not viewer.browsers, "closed pages are forgotten")
    assert errors == []


def picture(page: Any) -> np.ndarray:
    """The canvas alone: what the server drew."""
    content = page.locator("#view").evaluate("canvas => canvas.toDataURL('image/png')")
    return np.asarray(
        Image.open(io.BytesIO(base64.b64decode(content.split(",")[1]))).convert("RGB")
    )


def screenshot(page: Any, name: str, folder: Path) -> np.ndarray:
    path = Path(os.environ.get("MRGS_SCREENSHOTS", folder)) / name
    return np.asarray(Image.open(io.BytesIO(page.screenshot(path=path))).convert("RGB"))


def middle(page: Any) -> tuple[float, float]:
    box = page.locator("#view").bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def shown_celsius(page: Any, selector: str) -> float:
    page.wait_for_selector(f"{selector}:text-matches('°C')")
    return float(page.locator(selector).inner_text().split()[0].replace("−", "-"))


def limits_of(page: Any) -> tuple[float, ...]:
    texts = (page.locator(name).input_value() for name in ("#low", "#high"))
    return tuple(float(text.replace("−", "-")) for text in texts)


def test_the_temperature_under_the_cursor_needs_no_click(open_page, viewer, small_run, tmp_path):
    page = open_page()
    assert "token" not in page.url
    drawn = viewer.browsers[0].inspection.drawn
    page.mouse.move(*middle(page))
    told = shown_celsius(page, "#tip")
    rendered = small_run.temperatures_c(small_run.render(drawn.camera))
    row, column = (side // 2 for side in rendered.shape)
    assert told == pytest.approx(rendered[row, column].item(), abs=0.1)

    scale = drawn.scales[THERMAL]
    color = picture(page)[row, column].astype(int)
    place = np.abs(palette_table("inferno").astype(int) - color).sum(axis=1).argmin() / 255
    span = scale.high - scale.low
    assert scale.low + place * span == pytest.approx(told, abs=0.04 * span)
    assert page.locator("#view").evaluate("canvas => canvas.width") == page.locator(
        "#view"
    ).evaluate("canvas => canvas.clientWidth"), "not at the screen's resolution"
    screenshot(page, "viewer.png", tmp_path)


def test_marks_and_scale_lie_over_the_picture_and_not_in_it(open_page):
    page = open_page()
    before = picture(page)
    x, y = middle(page)
    page.mouse.click(x, y)
    page.wait_for_selector("#marks text")
    page.wait_for_selector(SETTLED)
    np.testing.assert_array_equal(picture(page), before)
    told = shown_celsius(page, "#value")
    assert page.locator("#marks text").text_content() == page.locator("#value").inner_text()
    assert page.locator("#deviation").inner_text().startswith("± ")
    ticks = page.locator(".scale span").all_inner_texts()
    numbers = [float(tick.split()[0].replace("−", "-")) for tick in ticks]
    assert len({round(step, 6) for step in np.diff(numbers)}) == 1
    assert min(numbers) - 20 < told < max(numbers) + 20


def test_the_scale_stays_while_the_view_moves(open_page):
    page = open_page()
    limits = limits_of(page)
    x, y = middle(page)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 150, y + 10, steps=5)
    page.mouse.up()
    page.wait_for_selector(SETTLED)
    assert limits_of(page) == limits
    page.check("#follow")
    wait_until(lambda: limits_of(page) != limits, "the scale follows when asked to", page)


def test_home_leads_back(open_page, viewer):
    page = open_page()
    start = picture(page)
    x, y = middle(page)
    page.mouse.move(x, y)
    page.mouse.wheel(0, 500)
    wait_until(lambda: not np.array_equal(picture(page), start), "the wheel is felt", page)
    page.click("#home")
    page.wait_for_selector(SETTLED)
    np.testing.assert_array_equal(picture(page), start)
    page.keyboard.press("Tab")
    page.locator("#view").focus()
    page.keyboard.press("ArrowLeft")
    wait_until(lambda: not np.array_equal(picture(page), start), "the key is felt", page)
    page.keyboard.press("h")
    page.wait_for_selector(SETTLED)
    np.testing.assert_array_equal(picture(page), start)


def test_marks_are_drawn_with_the_mouse_listed_changed_and_undone(open_page, viewer, tmp_path):
    page = open_page()
    rows = page.locator("#mark-list details")
    box = page.locator("#view").bounding_box()

    def at(x, y):
        return box["x"] + x * box["width"], box["y"] + y * box["height"]

    page.click("[data-kind=spot]")
    page.mouse.click(*at(0.5, 0.5))
    wait_until(lambda: rows.count() == 1, "the spot is listed", page)
    for count, kind in ((2, "line"), (3, "box")):
        page.click(f"[data-kind={kind}]")
        page.mouse.move(*at(0.45, 0.45))
        page.mouse.down()
        page.mouse.move(*at(0.55, 0.55), steps=3)
        page.mouse.up()
        wait_until(lambda count=count: rows.count() == count, f"the {kind} is listed", page)
    page.click("[data-kind=polygon]")
    for corner in ((0.45, 0.5), (0.5, 0.45), (0.55, 0.5)):
        page.mouse.click(*at(*corner))
    page.keyboard.press("Enter")
    wait_until(lambda: rows.count() == 4, "the polygon is listed", page)
    page.wait_for_selector(SETTLED)
    assert page.locator("#marks path.over").count() == 4
    rows.nth(1).locator("summary").click()
    assert rows.nth(1).locator("svg path").count() == 1
    assert "°C" in rows.nth(1).locator("svg text").first.text_content()
    rows.nth(2).locator("summary").click()
    rows.nth(2).get_by_label("Note").fill("a ball")
    page.keyboard.press("Tab")
    board = viewer.browsers[0].inspection.subject.board
    wait_until(lambda: board.marks.named("B1").note == "a ball", "the note is saved", page)
    screenshot(page, "viewer_marks.png", tmp_path)
    page.click("#undo")
    wait_until(lambda: board.marks.named("B1").note == "", "the note is taken back", page)
    rows.first.locator("summary").click()
    rows.first.get_by_role("button", name="Delete").click()
    wait_until(lambda: rows.count() == 3, "the spot is gone", page)
    page.click("[data-kind=spot]")
    page.keyboard.press("Escape")
    assert page.locator("#selector").is_hidden()


@pytest.fixture
def board(viewer: Viewer) -> MarkBoard:
    board = viewer._subject.board
    assert board is not None
    return board


@pytest.fixture
def disk(board: MarkBoard) -> MarkStore:
    """The marks, as another program opens them."""
    return MarkStore(board._store.folder, board._store._spread)


def draw_box(page: Any, left: float = 0.45) -> Any:
    """Draw a box in the middle of the picture, and unfold it; returns its row."""
    rows = page.locator("#mark-list details")
    count, area = rows.count(), page.locator("#view").bounding_box()
    page.click("[data-kind=box]")
    for number, share in enumerate((left, left + 0.1)):
        page.mouse.move(area["x"] + share * area["width"], area["y"] + share * area["height"])
        (page.mouse.up if number else page.mouse.down)()
    wait_until(lambda: rows.count() == count + 1, "the box is listed", page)
    rows.last.locator("summary").click()
    return rows.last


def said(row: Any, label: str) -> str:
    """What stands below a field."""
    return row.get_by_label(label, exact=True).locator("xpath=following-sibling::p[1]").inner_text()


def test_what_is_typed_after_a_new_name_is_saved(open_page, board):
    page = open_page()
    row = draw_box(page)
    row.get_by_label("Name").select_text()
    for text in ("Door", "a note", "2"):
        page.keyboard.type(text, delay=30)
        page.keyboard.press("Tab")
    wait_until(lambda: board.marks.marks[0].severity == "2", "the severity is saved", page)
    mark = board.marks.marks[0]
    assert (mark.name, mark.note) == ("Door", "a note")
    assert row.locator("summary b").inner_text() == "Door"
    assert row.get_attribute("open") is not None


def test_what_is_being_typed_stays_when_other_things_change(open_page, board, disk):
    page = open_page()
    row = draw_box(page)
    note = row.get_by_label("Note")
    note.focus()
    page.keyboard.type("half a no")
    disk.edit(lambda marks: marks.changing("B1", severity="3"))
    severity = row.get_by_label("Severity")
    wait_until(lambda: severity.input_value() == "3", "what another program wrote is shown", page)
    page.keyboard.type("te")
    page.keyboard.press("Tab")
    wait_until(lambda: board.marks.marks[0].note == "half a note", "the note is saved", page)
    assert board.marks.marks[0].severity == "3"
    disk.edit(lambda marks: marks.without("B1"))
    wait_until(lambda: row.count() == 0, "what another program deletes goes", page)


def test_a_change_that_is_taken_back_before_its_answer_is_saved(open_page, viewer, board):
    page = open_page()
    row = draw_box(page)
    wait_until(lambda: not viewer.busy, "the picture is drawn", page)
    go = threading.Event()
    viewer._worker.put("held", lambda: go.wait(60))
    note = row.get_by_label("Note")
    for text in ("first", ""):
        note.fill(text)
        page.keyboard.press("Tab")
    go.set()
    wait_until(lambda: not viewer.busy, "both are saved", page)
    assert board.marks.marks[0].note == ""
    page.wait_for_selector(SETTLED)
    assert note.input_value() == ""


def test_what_is_being_measured_anew_is_grey(open_page, board, monkeypatch):
    page = open_page()
    row = draw_box(page)
    go, measure = threading.Event(), board.picker.meter.measure
    monkeypatch.setattr(board.picker.meter, "measure", lambda *of: (go.wait(60), measure(*of))[1])
    value = row.locator("summary span").last
    known = value.evaluate("each => getComputedStyle(each).color")
    row.get_by_label("Emissivity").fill("0.5")
    page.keyboard.press("Tab")
    page.wait_for_selector("#measure-section.measuring")
    assert value.evaluate("each => getComputedStyle(each).color") != known
    go.set()
    page.wait_for_selector("#measure-section:not(.measuring)")
    assert value.evaluate("each => getComputedStyle(each).color") == known


def test_what_another_browser_saves_meanwhile_is_said(open_page, board, disk):
    page = open_page()
    row = draw_box(page)
    row.get_by_label("Note").focus()
    page.keyboard.type("mine")
    disk.edit(lambda marks: marks.changing("B1", note="theirs"))
    wait_until(lambda: said(row, "Note") == "Meanwhile saved as: theirs", "it is said", page)
    assert row.get_by_label("Note").input_value() == "mine"
    page.keyboard.press("Tab")
    wait_until(lambda: board.marks.marks[0].note == "mine", "the later one counts", page)
    assert said(row, "Note") == ""


def test_numbers_are_typed_with_a_point_or_a_comma(open_page, viewer, board):
    page = open_page()
    row = draw_box(page)
    for label, text in (("Emissivity", "0,85"), ("Reflected, °C", "−12,5")):
        row.get_by_label(label, exact=True).fill(text)
        page.keyboard.press("Tab")
        if label == "Emissivity":
            row.locator(".problem:has-text('give it too')").wait_for()
    wait_until(lambda: board.marks.marks[0].reflected_c is not None, "both are saved", page)
    assert (board.marks.marks[0].emissivity, board.marks.marks[0].reflected_c) == (0.85, -12.5)
    row.locator(".problem:empty").wait_for(state="attached")
    page.fill("#low", "-5,5")
    page.press("#low", "Enter")
    page.fill("#high", "20.12")
    page.press("#high", "Enter")
    assert limits_of(page) == (-5.5, 20.1)
    inspection = viewer.browsers[0].inspection
    wait_until(lambda: inspection.settings.limits[THERMAL] == (-5.5, 20.1), "it is used", page)
    page.select_option("#isotherm", "above")
    page.fill("#isotherm-low", "15,5")
    page.press("#isotherm-low", "Enter")
    wait_until(lambda: inspection.settings.isotherm == (15.5, 1e6), "it is taken", page)


def test_what_cannot_be_is_refused_at_its_field(open_page, board):
    page = open_page()
    draw_box(page)
    row = draw_box(page, 0.4)
    name, emissivity = (row.get_by_label(each) for each in ("Name", "Emissivity"))
    for text in ("8,5,1", "1.2", "lots"):
        emissivity.fill(text)
        page.keyboard.press("Tab")
        assert "0.01 to 1" in said(row, "Emissivity")
    name.fill("B1")
    page.keyboard.press("Tab")
    wait_until(lambda: said(row, "Name") != "", "it is refused", page)
    assert said(row, "Name").startswith("Not saved: ")
    assert "'B1'" in said(row, "Name")
    assert name.get_attribute("aria-invalid") == "true"
    assert (name.input_value(), emissivity.input_value()) == ("B1", "lots")
    name.fill("Door")
    page.keyboard.press("Tab")
    wait_until(lambda: board.marks.marks[1].name == "Door", "another name is taken", page)
    wait_until(lambda: said(row, "Name") == "", "the complaint goes", page)
    assert name.get_attribute("maxlength") == "40"
    for text, reason in (
        ("-1e9", "a number from −273 to 5000."),
        ("-300", "a number from −273 to 5000."),
        ("900", "The upper end must be above the lower."),
    ):
        page.fill("#low", text)
        page.press("#low", "Enter")
        assert page.locator("#range-said").inner_text().endswith(reason)
    page.locator("summary:has-text('Screenshot')").click()
    for text in ("", "0"):
        page.fill("#seconds", text)
        page.click("#save-path")
        assert page.locator("#seconds-said").inner_text().endswith("a number from 0.5 to 600.")


BOXES = """elements => elements.map((each) => {
    const { left, top, right, bottom } = each.getBoundingClientRect();
    return [left, top, right, bottom];
})"""


def test_labels_stay_in_their_pane_beside_their_marks_and_apart(open_page, board):
    page = open_page()
    page.keyboard.press("Tab")
    page.locator("#view").focus()
    for _ in range(12):
        page.keyboard.press("s")
    wait_until(lambda: len(board.marks) == 12, "spots are placed with a key", page)
    page.select_option("#compare", index=1)
    wait_until(lambda: page.locator("#marks > svg").count() == 2, "there are two panes", page)
    page.wait_for_selector(SETTLED)
    for pane in page.locator("#marks > svg").all():
        edge = pane.evaluate(
            "({ x, width }) => [x.baseVal.value, x.baseVal.value + width.baseVal.value]"
        )
        boxes = pane.locator("text").evaluate_all(BOXES)
        (x, y, *_), *others = pane.locator("path.over").evaluate_all(BOXES)
        assert len(others) == 11
        assert len(boxes) == 11, "labels without room are left out"
        for index, (left, top, right, bottom) in enumerate(boxes):
            assert edge[0] <= left < right <= edge[1]
            for x0, y0, x1, y1 in boxes[:index]:
                assert right <= x0 or x1 <= left or bottom <= y0 or y1 <= top
            if index:  # the first is the title
                assert min(abs(left - x), abs(right - x)) < 30
                assert abs((top + bottom) / 2 - y) < 60
    page.uncheck("#show-marks")
    wait_until(lambda: page.locator("#marks path.over").count() == 0, "they are hidden", page)


def test_the_middle_is_read_and_marked_with_keys(open_page, board):
    page = open_page()
    assert page.locator("#view").get_attribute("aria-label").endswith(", s marks it as a spot")
    assert page.locator("#spot-key").is_visible()
    page.locator("#view").focus()
    page.keyboard.press("Enter")
    told = shown_celsius(page, "#value")
    page.keyboard.press("s")
    wait_until(lambda: len(board.readings) == 1, "a spot is placed", page)
    assert board.readings[0].mean == pytest.approx(told, abs=0.5)
    page.keyboard.press("Control+s")
    page.keyboard.down("s")
    for _ in range(5):
        page.keyboard.down("s")  # it is held: these repeat
    page.keyboard.up("s")
    wait_until(lambda: len(board.readings) == 2, "a second spot is placed", page)
    page.wait_for_selector(SETTLED)
    assert len(board.readings) == 2


def test_only_controls_that_count_in_the_picture_are_shown(open_page):
    page = open_page()
    shown = {"#range-controls": True, "#palette": True, "#isotherm": True}
    for mode, expected in (
        ("Temperature", shown),
        ("Uncertainty", {**dict.fromkeys(shown, False), "#palette": True}),
        ("Depth", dict.fromkeys(shown, False)),
    ):
        page.locator("#modes button", has_text=re.compile(f"^{mode}")).click()
        for selector, visible in expected.items():
            assert page.locator(selector).is_visible() == visible, (mode, selector)
    page.locator("#modes button", has_text="Uncertainty").click()
    page.wait_for_selector(".scale:has-text('K')")


def test_a_long_name_keeps_its_line_beside_a_difference(open_page, board):
    page = open_page()
    draw_box(page)
    row = draw_box(page, 0.4)
    board.edit(lambda marks: replace(marks, reference="B1"))
    board.change(board.numbers[1], {"name": "Lintel above the kitchen window, north"})
    row.locator("summary:has-text('Lintel'):has-text('ΔT')").wait_for()
    name, value = (row.locator(f"summary {each}").bounding_box() for each in ("b", "span >> nth=1"))
    assert name["width"] > 120
    assert name["y"] == pytest.approx(value["y"], abs=4)
    assert row.locator("summary .muted").bounding_box()["y"] > name["y"] + 15


def test_the_legend_is_as_wide_as_its_numbers(open_page):
    page = open_page()
    page.fill("#high", "5000")
    page.press("#high", "Enter")
    page.wait_for_selector(".scale:has-text('4000')")
    card = page.locator(".scale").bounding_box()
    for left, _, right, _ in page.locator(".scale span").evaluate_all(BOXES):
        assert card["x"] <= left < right <= card["x"] + card["width"]


def test_alarms_begin_with_what_the_survey_states(open_page, board):
    survey = board._store.folder / SURVEY_FILE
    survey.write_text("inside_c: 22.5\nhumidity_percent: 61")
    board.refresh()
    page = open_page()
    page.select_option("#isotherm", "dew")
    air, humidity = page.locator("#isotherm-low"), page.locator("#isotherm-high")
    assert (air.input_value(), humidity.input_value()) == ("22.5", "61")
    assert page.locator("#isotherm-said").inner_text().endswith("14.6 °C.")
    air.fill("-300")
    air.press("Enter")
    assert "−45 to 60" in page.locator("#isotherm-said").inner_text()
    survey.unlink()
    board.refresh()


def test_proposals_are_accepted_and_dropped(open_page, viewer, tmp_path):
    page = open_page()
    page.click("[data-kind=spot]")
    box = page.locator("#view").bounding_box()
    page.mouse.click(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    wait_until(lambda: page.locator("#mark-list details").count() == 1, "the spot is listed", page)
    board = viewer.browsers[0].inspection.subject.board
    spot = board.marks.marks[0]
    found = tuple(replace(spot, name=name) for name in ("H1", "C1"))
    board.edit(lambda marks: replace(marks, proposals=found))
    rows = page.locator("#proposal-list .proposal")
    wait_until(lambda: rows.count() == 2, "the proposals are listed", page)
    page.locator("#proposals").scroll_into_view_if_needed()
    screenshot(page, "viewer_proposals.png", tmp_path)
    rows.first.get_by_role("button", name="Accept").click()
    wait_until(lambda: rows.count() == 1, "one is accepted", page)
    rows.first.get_by_role("button", name="Drop").click()
    wait_until(lambda: page.locator("#proposals").is_hidden(), "none is left", page)
    assert [mark.name for mark in board.marks.marks] == [spot.name, "H1"]
    assert [mark.name for mark in board.marks.dropped] == ["C1"]


def test_a_photo_can_be_gone_to(open_page, viewer, balls, tmp_path):
    page = open_page()
    page.select_option("#photo", balls.train[1].name)
    inspection = viewer.browsers[0].inspection
    wait_until(lambda: inspection.view is balls.train[1], "the photo is chosen", page)
    page.wait_for_selector(SETTLED)
    expected = balls.train[1].camera.position
    np.testing.assert_allclose(inspection.drawn.camera.position, expected, atol=1e-3)
    page.select_option("#compare", label="Photos beside the model")
    wait_until(lambda: page.locator("#marks text").count() == 4, "each part has a title", page)
    page.wait_for_selector(SETTLED)
    screenshot(page, "viewer_photos.png", tmp_path)
    page.click("[data-mode='1']")
    page.check("#show-cameras")
    page.wait_for_selector("#marks .camera")
    page.locator("#marks .camera").first.dispatch_event("click")
    wait_until(lambda: inspection.view is not balls.train[1], "a camera can be clicked on", page)


def test_a_hidden_page_asks_for_nothing(open_page, viewer):
    """A page behind another one is not called back for a frame."""
    page = open_page()
    page.wait_for_selector(SETTLED)
    page.evaluate("window.requestAnimationFrame = () => 1")  # as the browser does for hidden pages
    drawn = viewer.browsers[0].inspection.drawn
    viewer.refresh("The model has changed.")
    page.wait_for_selector("#note:text('The model has changed.')")
    page.wait_for_timeout(300)
    assert viewer.browsers[0].inspection.drawn is drawn
    viewer.note = ""


@pytest.mark.parametrize(("width", "height"), [(390, 844), (1024, 700), (1440, 900)])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_the_window(open_page, width, height, scheme, tmp_path):
    phone = width < 500
    page = open_page(
        viewport={"width": width, "height": height},
        color_scheme=scheme,
        has_touch=phone,
        is_mobile=phone,
    )
    image = screenshot(page, f"viewer_{width}_{scheme}.png", tmp_path)
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    if not phone:
        assert page.evaluate("document.documentElement.scrollHeight <= window.innerHeight")
    box = page.locator("#view").bounding_box()
    assert box["width"] * box["height"] > 0.4 * width * height
    for selector in ("#home", ".scale", "#modes"):
        # At once: the scale is made anew with every picture.
        place = page.eval_on_selector(selector, "e => e.getBoundingClientRect().toJSON()")
        assert 0 <= place["x"] <= place["x"] + place["width"] <= width
        assert 0 <= place["y"] <= place["y"] + place["height"] <= height
    header = image[10, width - 10]
    assert (header.mean() < 80) == (scheme == "dark")
    if phone:
        page.touchscreen.tap(*middle(page))
        page.wait_for_selector("#marks text")


def test_the_token_is_asked_for(browser, viewer):
    page = new_page(browser)
    page.goto(f"http://127.0.0.1:{viewer.port}/")
    page.get_by_label("Token").fill(viewer._gate.token)
    page.get_by_role("button", name="Open").click()
    page.wait_for_selector(SETTLED)
    page.context.close()


def test_the_end_of_the_viewer_is_said(browser, small_run):
    viewer = open_viewer(small_run, None, "127.0.0.1", 0)
    page = new_page(browser)
    page.goto(viewer.url)
    page.wait_for_selector(SETTLED)
    assert not page.locator("#photo-section").is_visible()
    viewer.close()
    page.wait_for_selector("#status:has-text('The connection to the viewer is lost')")
    page.context.close()


DECODE_WHEN_TOLD = """() => {
    const decode = createImageBitmap;
    const told = new Promise((resolve) => { window.decodeNow = resolve; });
    window.createImageBitmap = async (blob) => {
        document.getElementById("view").dataset.waits = "true";
        await told;
        return decode(blob);
    };
}"""


def test_the_end_stays_said_when_the_last_picture_is_shown_after_it(browser, small_run):
    viewer = open_viewer(small_run, None, "127.0.0.1", 0)
    page = new_page(browser)
    page.goto(viewer.url)
    page.wait_for_selector(SETTLED)
    page.evaluate(DECODE_WHEN_TOLD)
    width = page.locator("#view").get_attribute("width")
    page.set_viewport_size({"width": 700, "height": 500})
    page.wait_for_selector("#view[data-waits]")
    viewer.close()
    page.wait_for_selector("#status:has-text('The connection to the viewer is lost')")
    page.evaluate("() => decodeNow()")
    page.wait_for_selector(f"#view:not([width='{width}'])")
    assert page.locator("#status").is_visible()
    page.context.close()


def test_what_shows_no_surface_has_a_colour_of_its_own():
    tables = np.concatenate([palette_table(name) for name in PALETTE_CHOICES])
    assert np.abs(tables.astype(int) - NO_SURFACE_COLOR).sum(axis=1).min() > 15


def test_what_is_outlined_alone_is_kept_until_it_is_undone(open_page, small_run, tmp_path):
    page = open_page()
    start, box = picture(page), page.locator("#view").bounding_box()
    page.click("[data-keep=polygon]")
    for x, y in ((0.4, 0.4), (0.6, 0.4), (0.6, 0.6), (0.4, 0.6)):
        page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
    page.keyboard.press("Enter")
    page.wait_for_selector("#kept:text-matches('an outline and this box')")
    wait_until(lambda: not np.array_equal(picture(page), start), "the rest is gone", page)
    page.wait_for_selector(SETTLED)
    screenshot(page, "viewer_kept.png", tmp_path)
    field = page.get_by_label("z from")
    field.fill("low")
    field.blur()
    page.wait_for_selector("#keep-said:text-matches('a number')")
    field.fill("−9,5")
    field.blur()
    survey = small_run.folder.path / SURVEY_FILE
    wait_until(lambda: read_survey(survey).crop[2] == -9.5, "the side is moved", page)
    page.get_by_label("x to").fill("-90")
    page.get_by_label("x to").blur()
    page.wait_for_selector("#keep-said.warning:text-matches('no Gaussian')")
    for _ in range(2):
        page.click("#keep-undo")
    page.wait_for_selector("#kept:text-matches('All of the model')")
    wait_until(lambda: np.array_equal(picture(page), start), "all is shown again", page)
    page.click("#keep-undo")
    page.wait_for_selector("#keep-said:text-matches('nothing to undo')")
