from __future__ import annotations

import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from mrgs.errors import RunError
from mrgs.prepare.page.write import write_page
from mrgs.prepare.work import Work
from mrgs.scene.radiometry import ObjectParameters


def changed(prepared: Work, scene: Path, **found: Any) -> Work:
    """The same work in another folder, with these results alone."""
    nothing = {"poses": None, "rig": None, "georeference": None}
    return replace(prepared, scene=scene, **{**nothing, **found})


class Page(HTMLParser):
    """The page's words, tags and attributes."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.source = path.read_text(encoding="utf-8")
        self.words: list[str] = []
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.handlers: list[str] = []
        self.feed(self.source)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.sources += [value for name, value in attributes if name in ("src", "href") and value]
        self.handlers += [
            name for name, _ in attributes if name.startswith("on") or name == "style"
        ]

    def handle_data(self, data):
        self.words.append(data)


@pytest.fixture(scope="module")
def page(prepared) -> Page:
    path = write_page(prepared)
    assert path == prepared.scene / "prepare.html"
    return Page(path)


def test_the_page_tells_what_was_understood_and_what_to_do_next(page):
    for words in (
        "5 of 6 views are in the scene: 4 to train on, 1 held "
        "out", "mrgs train '", "table & chairs'",
        "1 warning:", "One photo was taken a day later.",
        "pairs", "6 pairs.", "5 min 12 s", "from before",
        "From above, north is up",
        "view 0", "held out", "view 1", "training", "not in the scene: too few features",
        "6 with °C", "FLIR E60 (6 photos)", "−1 to 83 °C", "Emissivity 0.95, as the file says. (6 "
                                                           "photos)",
        "RGB lens, 5 views", "320 × 240 px, 55.0° × "
                             "42.7°", "3.1 cm: the thermal camera is 3.1 right",
        "0.60 px (median), 1.40 px", "in 4 pairs; median residual 0.31 px", "By GPS.",
        "0.40 m (median)",
        "Set the scale by a known distance", "The scene is in metres already.",
        "IMG_7.jpg", "is cut off", "is not a photo",
    ):  # fmt: skip
        assert words in page.text, words


def test_where_the_training_follows_by_itself_the_page_names_no_other_command(prepared, tmp_path):
    scene = shutil.copytree(prepared.scene, tmp_path / "scene")
    text = Page(write_page(replace(prepared, scene=scene, trains=True))).text
    assert "mrgs train" not in text
    assert "again with --yes" in text


def test_the_page_shows_the_settings_of_the_temperatures(prepared, tmp_path, page):
    assert "Emissivity not in" in page.text
    parameters = ObjectParameters(0.7, 2.5, -10.0, 20.0, 0.5)
    views = list(prepared.images.views)
    for index, view in enumerate(views[1:], 1):
        facts = view.facts.adding(
            parameters=replace(parameters, distance_m=index), given={"emissivity": 0.7}
        )
        views[index] = replace(view, facts=facts)
    scene = shutil.copytree(prepared.scene, tmp_path / "scene")
    images = replace(prepared.images, views=tuple(views))
    text = Page(write_page(replace(prepared, scene=scene, images=images))).text
    for words in (
        "Emissivity 0.70, given by you; not known of 1 photo",
        "Reflected temperature −10.0 °C, from the photos; not known of 1 photo",
        "Distance 1.0 to 5.0 m, from the photos; differs between the photos",
    ):
        assert words in text


def test_everything_is_in_the_file(page):
    assert "default-src 'none'" in page.source
    assert all(source.startswith("data:image/") for source in page.sources)
    assert page.handlers == []
    assert page.tags.count("script") == 2


def test_text_from_files_is_no_markup(page):
    assert "<b>match</b>" in page.text
    assert "alert(1)" in page.text
    assert "b" not in page.tags
    assert "onerror=alert(1)>" not in page.source.replace("&gt;", "")
    assert "</script>alert" not in page.source


def test_each_view_is_shown_with_its_thermal_image_on_its_photo(page):
    assert page.source.count('class="card"') == 5
    assert page.source.count('class="card failed"') == 1
    assert page.source.count('class="warped"') == page.source.count('class="edges"') == 5


def test_some_of_many_views_are_shown_and_the_charts_say_so(prepared, tmp_path):
    shutil.copytree(prepared.scene, tmp_path / "scene")
    steps: list[tuple[str, int, int]] = []
    work = replace(prepared, scene=tmp_path / "scene", on_progress=lambda *step: steps.append(step))
    page = Page(write_page(work, most_shown=3))
    assert "3 of 6 photos" in page.text
    assert steps == [
        (f": {step}", done, 3) for step in ("reading images", "drawing") for done in range(3)
    ]


def test_a_set_without_poses_is_shown_too(prepared, tmp_path):
    for folder in ("images", "thermal"):
        (tmp_path / folder).symlink_to(prepared.scene / folder)
    page = Page(write_page(changed(prepared, tmp_path, reports=prepared.reports[:1])))
    assert "no scene yet" in page.text
    assert "mrgs train" not in page.text
    assert page.source.count('class="card failed"') == 6
    assert "6 with °C" in page.text


def test_poses_without_a_thermal_camera_are_shown_and_can_be_measured(prepared, tmp_path):
    for folder in ("images", "thermal"):
        (tmp_path / folder).symlink_to(prepared.scene / folder)
    found = prepared.poses
    page = Page(
        write_page(
            changed(
                prepared,
                tmp_path,
                reports=prepared.reports[:2],
                poses=found,
                georeference=prepared.georeference,
            )
        )
    )
    assert "no scene yet" in page.text
    assert f"{len(found.points.positions):,}" in page.text
    assert "By GPS." in page.text
    assert "One camera" not in page.text
    assert "too few features" in page.text
    assert 'id="measure"' in page.source


def test_an_image_that_has_gone_is_told_beside_its_view(prepared, tmp_path):
    (tmp_path / "images").symlink_to(prepared.scene / "images")
    images = replace(prepared.images, views=prepared.images.views[:1])
    work = changed(prepared, tmp_path, reports=[], images=images)
    assert "cannot be decoded" in Page(write_page(work)).text


def test_a_page_that_cannot_be_written_is_told(prepared, tmp_path):
    (tmp_path / "prepare.html").mkdir()
    work = changed(prepared, tmp_path, reports=[], images=replace(prepared.images, views=()))
    with pytest.raises(RunError, match=r"prepare\.html cannot"):
        write_page(work)
