from __future__ import annotations

import base64
import gzip
import hashlib
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from mrgs import export_run
from mrgs.errors import ConfigError, RunError
from mrgs.export.page import write
from mrgs.export.page.write import (
    PHOTO_PX,
    PageContent,
    area_facts,
    view_photos,
    visible_range,
    write_page,
)
from mrgs.marks import Mark, Marks
from mrgs.marks.emissivity import TYPICAL_LAW, CaptureSettings, SurfaceSettings
from mrgs.marks.regions import Regions
from mrgs.run_files.folder import RunFolder
from mrgs.scene import THERMAL
from mrgs.survey import SURVEY_FILE, Survey, write_survey
from tests.helpers.packed import pack
from tests.helpers.walls import RANGE, render_wall

SQUARE = ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))


class Elements(HTMLParser):
    """Tags with their attributes, and the text of each element with an id or a class, of the title
    and of the script."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, str] = {}
        self._open = ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        self._open = dict(attributes).get("id") or dict(attributes).get("class") or tag

    def handle_data(self, data):
        self.texts[self._open] = self.texts.get(self._open, "") + data

    def handle_endtag(self, tag):
        self._open = ""


@pytest.fixture
def page(baked, cameras, tmp_path):
    return Elements(
        write_page(baked, cameras, "Kettle", tmp_path / "page.html").read_text(encoding="utf-8")
    )


def test_the_page_carries_the_packed_model_and_the_cameras(page, baked, cameras):
    facts, packed = json.loads(page.texts["facts"]), pack(baked)
    part = json.loads(page.texts["part"])
    assert base64.b64decode(part["data"]) == packed.data
    assert part["header"] == {**packed.header, "first": 0, "replaces": [0, 0]}
    dilation = {"px2": 0.1, "finest_focal_px": 107.0, "least_px2": 0.01}
    known = {"parts": 1, "slots": 1024, "dilation": dilation}
    law = {name: getattr(baked.radiance, name) for name in ("gain", "offset", "least", "coldest_k")}
    known["radiance"] = {"low_k": 263.15, "span_k": 100.0, "b": TYPICAL_LAW.b, **law}
    assert facts["model"] == {"count": packed.header["count"], **known}
    assert [camera["width"] for camera in facts["cameras"]] == [96] * 5
    assert facts["cameras"][2]["position"] == pytest.approx(cameras["view 2"].position.tolist())
    heat, colour = facts["modalities"]
    assert (colour["label"], colour["channels"], colour["metric"]) == ("Colour", 3, False)
    assert (heat["label"], heat["channels"], heat["metric"]) == ("Temperature", 1, True)
    assert heat["scale"] == {"min": -10.0, "max": 90.0, "unit": "°C", "decimals": 1}
    assert heat["range"] == pytest.approx(visible_range(baked, THERMAL, list(cameras.values())))
    assert facts["readable"] == ["thermal"]
    assert facts["world"]["up"][2] > 0.9


def test_the_palette_starts_with_the_corrected_temperatures(baked, cameras):
    class Warmer:
        def applied_to(self, rendering, camera):
            return rendering.with_images({THERMAL: rendering[THERMAL].image + 0.1})

    seen = list(cameras.values())
    plain, corrected = (visible_range(baked, THERMAL, seen, each) for each in (None, Warmer()))
    np.testing.assert_allclose(corrected, np.add(plain, 10), atol=1e-4)


def test_areas_have_their_depths_where_the_model_shows_them():
    capture = CaptureSettings(SurfaceSettings(0.95, 20.0), TYPICAL_LAW)
    seen, aside = (
        Mark(name, "box", tuple((x + shift, 0.0, z) for x, z in SQUARE), (shift, -5.0, 0.0),
             emissivity=0.5, reflected_c=0.0)
        for name, shift in (("B1", 0.0), ("B2", 30.0))
    )  # fmt: skip
    facts = area_facts(Regions(Marks((seen, aside)), render_wall, RANGE, capture))
    (area,) = facts["areas"]
    width, height = area["camera"]["width"], area["camera"]["height"]
    codes = np.frombuffer(gzip.decompress(base64.b64decode(area["depths"])), "<u2")
    assert len(codes) == width * height
    assert (codes > 0).mean() > 0.99
    depths = area["nearest"] * np.exp(area["step"] * (codes[codes > 0] - 1.0))
    np.testing.assert_allclose(depths, 5.0, rtol=1e-3)
    for side, focal, middle in (("width", "fx", "cx"), ("height", "fy", "cy")):
        ends = (np.array([0, area["camera"][side]]) - area["camera"][middle]) / area["camera"][
            focal
        ]
        np.testing.assert_allclose(5.0 * ends, [-0.5, 0.5], atol=0.1)
    assert area["gain"] == 0.95 / 0.5
    assert area_facts(Regions(Marks((aside,)), render_wall, RANGE, capture)) is None


def test_nothing_comes_from_elsewhere(page):
    assert not [tag for tag in page.tags if tag[0] in ("link", "iframe", "object", "embed", "base")]
    assert not [
        value
        for _, attributes in page.tags
        for name, value in attributes.items()
        if name in ("src", "href")
    ]
    assert not [
        text
        for name, text in page.texts.items()
        if name != "part" and re.search(r"https?:|//cdn|@import", text)
    ]


def test_the_policy_allows_this_script_and_style_only(page):
    policy = next(a["content"] for tag, a in page.tags if tag == "meta" and "http-equiv" in a)
    for name in ("script", "style"):
        digest = base64.b64encode(hashlib.sha256(page.texts[name].encode()).digest()).decode()
        assert f"{name}-src 'sha256-{digest}'" in policy
    assert policy.startswith("default-src 'none';")
    assert "unsafe" not in policy


def test_all_text_is_escaped(baked, cameras, tmp_path):
    evil = "</title><script>alert('x')</script>&\""
    named = {evil + name: camera for name, camera in cameras.items()}
    path = write_page(baked, named, evil, tmp_path / "page.html", PageContent(notes=[evil]))
    text = path.read_text(encoding="utf-8")
    assert "alert('x')" not in text
    assert text.count(
        "&lt;/title&gt;&lt;script&gt;alert(&#39;x&#39;)&lt;/script&gt;&amp;&#34;"
    ) == 3 + len(cameras)
    assert Elements(text).texts["title"] == evil


def test_whatever_marks_and_modalities_are_called_the_facts_stay_one_element(
    baked, cameras, tmp_path
):
    evil = "</script><!--<script>'\"\u2028&lt; <img src=x onerror=alert(1)>"
    mark = {"name": evil, "note": f"{evil}\n{evil}", "label": evil, "points": [[0.0, 0.0, 0.0]]}
    text = write_page(
        baked, cameras, "t", tmp_path / "page.html", PageContent(marks=[mark], settings=evil)
    ).read_text(encoding="utf-8")  # fmt: skip
    page = Elements(text)
    assert json.loads(page.texts["facts"])["marks"] == [mark]
    assert "<img src" not in text
    assert "<!--" not in text
    assert evil.replace("\u2028", r"\u2028") in page.texts["li"]
    assert [tag for tag, _ in page.tags].count("script") == 4


def test_the_page_says_what_its_temperatures_are(page, baked, cameras, tmp_path):
    notes = " ".join(page.texts[name] for name in ("li", "h2"))
    for word in ("emissivity", "shiny", "unreliable", "−10 to 90 °C"):
        assert word in notes
    assert "does not record" in notes
    assert "apparent" not in notes
    content = PageContent(settings="emissivity 0.70")
    known = write_page(baked, cameras, "t", tmp_path / "known.html", content)
    words = " ".join(Elements(known.read_text(encoding="utf-8")).texts["li"].split())
    assert "emissivity 0.70" in words
    unknown = write_page(replace(baked, temperature=None), cameras, "t", tmp_path / "unknown.html")
    text = Elements(unknown.read_text(encoding="utf-8"))
    assert "hold no °C" in text.texts["li"]
    heat = json.loads(text.texts["facts"])["modalities"][0]
    assert heat["scale"] == {"min": 0.0, "max": 1.0, "unit": "", "decimals": 3}


@pytest.mark.parametrize("settings", ["", "emissivity 0.70"])
@pytest.mark.parametrize("areas", [None, {"areas": []}])
def test_sentences_are_apart(baked, cameras, tmp_path, monkeypatch, settings, areas):
    monkeypatch.setattr(write, "area_facts", lambda regions: areas)
    square = tuple((x, 0.0, z) for x, z in SQUARE)
    box = Mark("B1", "box", square, (0.0, -5.0, 0.5), emissivity=0.5, reflected_c=20.0)
    regions = Regions(Marks((box,)), render_wall, RANGE, CaptureSettings())
    content = PageContent(settings=settings, regions=regions)
    for shown in (baked, replace(baked, temperature=None)):
        path = write_page(shown, cameras, "t", tmp_path / "p.html", content)
        html = path.read_text(encoding="utf-8")
        said = re.sub("<[^>]*>", " | ", html[html.index("<h1>") : html.index("</main>")])
        assert "Bare metal" in said
        assert re.findall(r"[a-z0-9][.:;][A-Z]\w*", said) == []


def test_the_photos_of_the_views_come_last(baked, cameras, scene, tmp_path):
    photos = view_photos(scene)
    assert list(photos) == [view.name for view in scene.views]
    assert max(max(each.width, each.height) for each in photos.values()) <= PHOTO_PX
    named = dict(zip(photos, cameras.values(), strict=False))
    path = write_page(baked, named, "t", tmp_path / "p.html", PageContent(photos=photos))
    text = path.read_text(encoding="utf-8")
    shown = re.findall(r'<script type="text/plain" class="photo" data-camera="(\d+)">(.{11})', text)
    assert shown == [(str(index), "data:image/") for index in range(len(named))]
    assert text.index('class="photo"') > text.rindex('class="part"')


def test_a_survey_leaves_the_photos_out(run, tmp_path):
    own = replace(run, folder=RunFolder(shutil.copytree(run.folder.path, tmp_path / "run")))
    for stated, expected in ((None, True), (False, False)):
        write_survey(own.folder.path / SURVEY_FILE, Survey(photos_in_page=stated))
        (path,) = export_run(own, format="page")
        assert ('class="photo"' in path.read_text(encoding="utf-8")) is expected


def test_the_page_begins_with_the_colours_that_the_survey_states(run, tmp_path):
    own = replace(run, folder=RunFolder(shutil.copytree(run.folder.path, tmp_path / "run")))
    stated = Survey(palette="iron", scale_low_c=12.0, scale_high_c=28.0)
    write_survey(own.folder.path / SURVEY_FILE, stated)
    for palette, expected in ((None, "iron"), ("inferno", "inferno"), ("grey", "grey")):
        (path,) = export_run(own, format="page", palette=palette)
        page = Elements(path.read_text(encoding="utf-8"))
        assert json.loads(page.texts["facts"])["modalities"][0]["range"] == [12.0, 28.0]
        assert {"value": expected, "selected": None} in [a for tag, a in page.tags]


def test_depths_have_the_unit_of_the_scene(page, baked, cameras, tmp_path):
    assert json.loads(page.texts["facts"])["length_unit"] == "scene units"
    assert "scene units" in page.texts["dd"]
    path = write_page(baked, cameras, "t", tmp_path / "p.html", PageContent(length_unit="m"))
    metric = Elements(path.read_text(encoding="utf-8"))
    assert json.loads(metric.texts["facts"])["length_unit"] == "m"
    assert "scene units" not in "".join(metric.texts.values())


def test_every_modality_of_the_model_is_offered(with_nir, cameras, tmp_path):
    path = write_page(with_nir, cameras, "t", tmp_path / "p.html")
    page = Elements(path.read_text(encoding="utf-8"))
    facts = json.loads(page.texts["facts"])
    names = [modality["name"] for modality in facts["modalities"]]
    assert names == ["thermal", "rgb", "nir"]
    assert facts["readable"] == ["thermal", "nir"]
    assert facts["modalities"][2] == {
        "name": "nir",
        "label": "Near infrared",
        "channels": 1,
        "metric": False,
        "scale": {"min": 0.0, "max": 1.0, "unit": "", "decimals": 3},
        "range": [0.0, 1.0],
    }
    buttons = [a["data-modality"] for tag, a in page.tags if "data-modality" in a]
    assert buttons == names


def test_palette_range_and_start_can_be_chosen(baked, cameras, tmp_path):
    content = PageContent("iron", (10.0, 30.0), start="view 3")
    path = write_page(baked, cameras, "t", tmp_path / "p.html", content)
    page = Elements(path.read_text(encoding="utf-8"))
    facts = json.loads(page.texts["facts"])
    assert facts["modalities"][0]["range"] == [10.0, 30.0]
    assert [a for tag, a in page.tags if tag == "option" and "selected" in a] == [
        {"value": "iron", "selected": None},
        {"selected": None},
    ]
    assert "<option selected>view 3</option>" in path.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"modalities": ()}, "modality"),
        ({"palette": "depth"}, "depth.*black-hot"),
        ({"range_c": (30.0, 30.0)}, "30 to 30"),
        ({"range_c": (float("nan"), 30.0)}, "nan to 30"),
    ],
)
def test_bad_options_are_named(baked, cameras, tmp_path, options, message):
    with pytest.raises(ConfigError, match=message):
        write_page(baked, cameras, "t", tmp_path / "page.html", PageContent(**options))
    assert not list(tmp_path.iterdir())


def test_a_page_needs_a_camera(baked, tmp_path):
    with pytest.raises(ConfigError, match="camera"):
        write_page(baked, {}, "t", tmp_path / "page.html")


def test_a_place_that_cannot_be_written_is_named(baked, cameras, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=r"page\.html"):
        write_page(baked, cameras, "t", tmp_path / "file" / "page.html")
