from __future__ import annotations

import io
import os
import random
import struct
import sys
import tempfile
import unicodedata
from collections.abc import Callable, Iterable
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from mrgs.errors import ConfigError, SceneError
from mrgs.prepare.contract import Pairing, SeveralCamerasError
from mrgs.prepare.options import PrepareOptions
from mrgs.prepare.pairs.find import find_pairs
from mrgs.prepare.pairs.inventory import take_inventory
from mrgs.scene import RGB, THERMAL
from tests.helpers.flir import FlirPhoto, jpg
from tests.helpers.photos import photo

NOON = datetime(2024, 5, 1, 12, 0, 0)
TABLE = b"\n".join([b"20,5;" * 20] * 4)


def files(root: Path, found: Pairing) -> list[tuple[str | None, str]]:
    """The pairs by the paths of their files."""
    return [
        (
            None if RGB not in pair.photos else pair.photos[RGB].relative_to(root).as_posix(),
            pair.photos[THERMAL].relative_to(root).as_posix(),
        )
        for pair in found.pairs
    ]


def reasons(found: Pairing) -> dict[str, str]:
    return {item.name: item.reason for item in found.skipped}


def assert_left_out(found: Pairing, keywords: dict[str, str]) -> None:
    """Exactly these files are left out, each for the reason that its keyword stands for."""
    told = reasons(found)
    assert told.keys() == keywords.keys()
    for name, keyword in keywords.items():
        assert keyword in told[name], name


def at(seconds: float, **more: object) -> dict[str, object]:
    return {"taken": NOON + timedelta(seconds=seconds), **more}


@pytest.mark.parametrize(
    ("content", "pairs"),
    [
        (
            {
                "DJI_0002_T.JPG": "celsius",
                "DJI_0002_W.JPG": "jpg",
                "DJI_0010_T.JPG": "celsius",
                "DJI_0010_W.JPG": "jpg",
            },
            [
                ("DJI_0002", "DJI_0002_W.JPG", "DJI_0002_T.JPG"),
                ("DJI_0010", "DJI_0010_W.JPG", "DJI_0010_T.JPG"),
            ],
        ),
        (
            {
                "DCIM/A/DJI_20230101120000_0001_T.JPG": "jpg",
                "DCIM/A/DJI_20230101120001_0001_V.JPG": "jpg",
            },
            [
                (
                    "DJI_0001",
                    "DCIM/A/DJI_20230101120001_0001_V.JPG",
                    "DCIM/A/DJI_20230101120000_0001_T.JPG",
                )
            ],
        ),
        (
            {
                "wall.jpg": "jpg",
                "wall_thermal.png": "png",
                "door.jpg": "jpg",
                "door_thermal.png": "png",
            },
            [("door", "door.jpg", "door_thermal.png"), ("wall", "wall.jpg", "wall_thermal.png")],
        ),
        ({"a.jpg": "jpg", "a.tif": "celsius"}, [("a", "a.jpg", "a.tif")]),
        (
            {
                "x/a.jpg": "jpg",
                "x/a.tif": "celsius",
                "y/a.jpg": ("jpg", at(9)),
                "y/a.tif": ("celsius", at(9)),
            },
            [("x_a", "x/a.jpg", "x/a.tif"), ("y_a", "y/a.jpg", "y/a.tif")],
        ),
    ],
)
def test_names(photos, content, pairs):
    root = photos(content)
    for rule in ("auto", "names"):
        found = find_pairs(root, PrepareOptions(pairs=rule))
        assert [
            (pair.name, *both) for pair, both in zip(found.pairs, files(root, found), strict=True)
        ] == pairs
        assert "suffix" in found.rule
        assert found.skipped == found.warnings == ()


@pytest.mark.parametrize(
    ("content", "pairs"),
    [
        ({"rgb/1.jpg": "jpg", "thermal/1.png": "png"}, [("rgb/1.jpg", "thermal/1.png")]),
        (
            {
                "Images/train/1_rgb.jpg": "jpg",
                "IR/train/1_ir.jpg": "jpg",
                "IR/test/1_ir.jpg": ("jpg", at(9)),
            },
            [("Images/train/1_rgb.jpg", "IR/train/1_ir.jpg")],
        ),
        (
            {"visible/100/1.jpg": "jpg", "thermal/101/1.jpg": "jpg"},
            [("visible/100/1.jpg", "thermal/101/1.jpg")],
        ),
        (
            {"house/rgb/1.jpg": "jpg", "house/flir/1.jpg": "flir"},
            [("house/rgb/1.jpg", "house/flir/1.jpg")],
        ),
    ],
)
def test_folders(photos, content, pairs):
    root = photos(content)
    for rule in ("auto", "folders"):
        found = find_pairs(root, PrepareOptions(pairs=rule))
        assert files(root, found) == pairs
        assert "folders" in found.rule


@pytest.mark.parametrize(("step", "word"), [(1, "next"), (-1, "previous")])
def test_neighbouring_numbers(photos, step, word):
    numbers = (10, 12, 14)
    thermal = {f"DCIM/100_FLIR/FLIR{n:04d}.jpg": ("flir", at(60 * n)) for n in numbers}
    visible = {f"DCIM/100_FLIR/FLIR{n + step:04d}.jpg": ("jpg", at(60 * n + 3)) for n in numbers}
    root = photos(thermal | visible)
    found = find_pairs(root)
    assert files(root, found) == list(zip(visible, thermal, strict=True))
    assert f"{word} number" in found.rule


def test_neighbours_of_other_names(photos):
    root = photos({"IR_0009.jpg": "flir", "DC_0010.jpg": "jpg"})
    assert files(root, find_pairs(root)) == [("DC_0010.jpg", "IR_0009.jpg")]


def test_neighbours_that_were_taken_far_apart_are_no_pair(photos):
    root = photos({"IR_1.jpg": ("flir", at(0)), "DC_2.jpg": ("jpg", at(60))})
    with pytest.raises(SceneError, match="neither names nor times"):
        find_pairs(root)


@pytest.mark.parametrize(
    "stems",
    [
        ["1s", "1w", "2s", "2w"],
        ["house_1s", "house_1v", "house_1w"],
        ["panel01t", "panel01v", "panel02t", "panel02v"],
        ["Color_wall_0", "IR_wall_0", "Color_wall_1", "IR_wall_1"],
    ],
)
@pytest.mark.parametrize("rule", ["auto", "folders"])
def test_names_that_are_equal_to_the_letter_go_before_suffixes(photos, stems, rule):
    content = {f"thermal/{stem}.tif": "celsius" for stem in stems}
    root = photos(content | {f"rgb/{stem}.jpg": "jpg" for stem in stems})
    found = find_pairs(root, PrepareOptions(pairs=rule))
    assert sorted(files(root, found)) == [
        (f"rgb/{stem}.jpg", f"thermal/{stem}.tif") for stem in sorted(stems)
    ]
    assert found.skipped == ()


@pytest.mark.parametrize(
    "name", ["thermal survey", "IR 2024", "FLIR", "my_ir_photos", "photos", "job42"]
)
@pytest.mark.parametrize("thermal", ["A{i:03d}.tif", "IR_{i:04d}.jpg"])
def test_the_folder_of_all_photos_may_have_any_name(photos, name, thermal):
    kind = "celsius" if thermal.endswith("tif") else "png"
    content = {thermal.format(i=i): (kind, at(100 * i)) for i in range(4)}
    content |= {f"DSC_{i + 100}.jpg": ("jpg", at(100 * i)) for i in range(4)}
    root = photos(content)
    root = root.rename(root.with_name(name))
    found = find_pairs(root)
    assert files(root, found) == [(f"DSC_{i + 100}.jpg", thermal.format(i=i)) for i in range(4)]


@pytest.mark.parametrize("lost", [4, 11])
def test_a_photo_that_is_missing_in_a_row_of_equal_numbers_is_doubted(photos, lost):
    moments = [20 * i + (i * i) % 7 for i in range(16)]
    thermal = {f"thermal/{i:02d}.tif": ("celsius", at(t)) for i, t in enumerate(moments)}
    left = [t for i, t in enumerate(moments) if i != lost]
    rgb = {f"rgb/{i:02d}.jpg": ("jpg", at(t + 100)) for i, t in enumerate(left)}
    found = find_pairs(photos(thermal | rgb))
    (warning,) = found.warnings
    # At the end of a shifted row no other photo is nearer.
    first = "01" if lost == 4 else "11"
    assert "3 of 15 pairs" in warning
    assert f"{first}.jpg and {first}.tif" in warning


@pytest.mark.parametrize("jitter_s", [0, 6])
def test_pairs_that_are_taken_by_hand_one_after_the_other_are_not_doubted(photos, jitter_s):
    draw = random.Random(0)
    thermal = {f"thermal/{i:02d}.tif": ("celsius", at(20 * i)) for i in range(16)}
    rgb = {
        f"rgb/{i:02d}.jpg": ("jpg", at(20 * i + 5 + draw.uniform(-jitter_s, jitter_s)))
        for i in range(16)
    }
    assert find_pairs(photos(thermal | rgb)).warnings == ()


def test_a_backup_of_the_card_adds_no_views(photos):
    card = {f"{kind}_{i}.jpg": (kind, at(60 * i)) for i in range(3) for kind in ("flir", "jpg")}
    names = {name: name.replace("flir", "IR").replace("jpg_", "DC_") for name in card}
    content = {
        f"{folder}/{names[name]}": value
        for folder in ("card", "card backup")
        for name, value in card.items()
    }
    found = find_pairs(photos(content), PrepareOptions(pairs="time"))
    assert [pair.photos[THERMAL].name for pair in found.pairs] == [
        "IR_0.jpg",
        "IR_1.jpg",
        "IR_2.jpg",
    ]
    assert {pair.photos[RGB].parent.name for pair in found.pairs} == {"card"}
    assert_left_out(
        found, {f"card backup/{name}": f"copy of card/{name}" for name in names.values()}
    )


def test_visible_photos_inside(photos):
    root = photos(
        {
            "a.jpg": "flir with visible",
            "b.jpg": "flir with visible",
            "c.jpg": "flir",
            "d.jpg": "jpg",
        }
    )
    found = find_pairs(root)
    assert files(root, found) == [(None, "a.jpg"), (None, "b.jpg")]
    assert all(pair.embedded for pair in found.pairs)
    assert "embedded" in found.rule
    assert_left_out(found, {"c.jpg": "no RGB", "d.jpg": "embedded"})


def test_photos_beside_are_better_than_photos_inside(photos):
    root = photos({"IR_1.jpg": "flir with visible", "DC_2.jpg": "jpg"})
    found = find_pairs(root)
    assert files(root, found) == [("DC_2.jpg", "IR_1.jpg")]
    assert not found.pairs[0].embedded


@pytest.mark.parametrize(("beside", "embedded"), [(9, False), (8, True)])
def test_a_missing_photo_beside_does_not_make_those_inside_better(photos, beside, embedded):
    content = {f"IR_{2 * i:04d}.jpg": "flir with visible" for i in range(10)}
    root = photos(content | {f"DC_{2 * i + 1:04d}.jpg": "jpg" for i in range(beside)})
    found = find_pairs(root)
    assert {pair.embedded for pair in found.pairs} == {embedded}
    assert len(found.pairs) == (10 if embedded else beside)
    if not embedded:
        assert_left_out(found, {"IR_0018.jpg": "next number"})


def test_times_of_two_clocks(photos):
    moments = (0, 31, 45, 90, 200)
    thermal = {f"thermal/T{i}.png": ("png", at(t)) for i, t in enumerate(moments)}
    rgb = {f"rgb/P{i + 70}.jpg": ("jpg", at(t + 3601)) for i, t in enumerate(moments)}
    extra = {"rgb/P99.jpg": ("jpg", at(3700)), "rgb/P0.jpg": "jpg"}
    root = photos(thermal | rgb | extra)
    for rule in ("auto", "time"):
        found = find_pairs(root, PrepareOptions(pairs=rule))
        assert files(root, found) == list(zip(rgb, thermal, strict=True))
        assert "within 2 s" in found.rule
        assert "3601.0 s ahead" in found.rule
        assert_left_out(found, {"rgb/P0.jpg": "when it was taken", "rgb/P99.jpg": "within 2 s"})


@pytest.mark.parametrize("count", [12, 11])
def test_clocks_that_cannot_be_told_apart(photos, count):
    """An offset that pairs fewer photos is named; one that pairs as many is asked about."""
    thermal = {f"thermal/T{i:02d}.png": ("png", at(10 * i)) for i in range(12)}
    rgb = {f"rgb/P{i:02d}.jpg": ("jpg", at(10 * i - 500)) for i in range(count)}
    found = find_pairs(photos(thermal | rgb))
    assert len(found.pairs) == count
    said = found.rule if count == 12 else found.warnings[0]
    assert "offset may also be" in said
    assert len(found.warnings) == (count == 11)


@pytest.mark.parametrize(
    "converted", ["DJI_0001_T.tif", "celsius/DJI_0001_T.tiff", "DJI_0001_T.JPG.tiff"]
)
def test_a_converted_photo_stands_for_its_original(photos, converted):
    original = ("dji", at(0, model="DJI M3T"))
    root = photos(
        {
            "card/DJI_0001_T.JPG": original,
            "card/DJI_0001_W.JPG": "jpg",
            f"card/{converted}": "celsius",
        }
    )
    found = find_pairs(root)
    assert files(root, found) == [("card/DJI_0001_W.JPG", f"card/{converted}")]
    assert_left_out(found, {"card/DJI_0001_T.JPG": f"taken from card/{converted}"})


@pytest.mark.parametrize("table", ["thermal/IMG_0001.csv", "csv/IMG_0001.csv"])
@pytest.mark.parametrize(
    ("original", "data"),
    [
        ("IMG_0001.jpg", photo("jpg") + b"HDRI" + bytes(64) + b"HIPT"),
        ("IMG_0001.bmt", b"BM" + bytes(64)),
    ],
)
def test_a_table_stands_for_a_file_that_only_its_maker_reads(photos, original, data, table):
    root = photos({f"thermal/{original}": data, "rgb/IMG_0001.jpg": "jpg", table: TABLE})
    found = find_pairs(root)
    assert files(root, found) == [("rgb/IMG_0001.jpg", table)]
    assert_left_out(found, {f"thermal/{original}": f"taken from {table}"})


@pytest.mark.parametrize("size", [(16, 12), (24, 20)])
@pytest.mark.parametrize(
    ("numbers", "preview", "rgb"),
    [
        ("thermal/IMG_0001.tif", "thermal/IMG_0001.jpg", "rgb/IMG_0001.jpg"),
        ("IRX_0001.tif", "IRX_0001.jpg", "MAX_0001.jpg"),
        ("0001_ir.csv", "0001_ir.jpg", "0001_rgb.jpg"),
    ],
)
def test_a_preview_of_the_temperatures_is_no_rgb_photo(photos, numbers, preview, rgb, size):
    content = TABLE if numbers.endswith("csv") else "celsius"
    root = photos({numbers: content, preview: ("jpg", {"size": size}), rgb: "jpg"})
    found = find_pairs(root)
    assert files(root, found) == [(rgb, numbers)]
    assert_left_out(found, {preview: f"taken from {numbers}"})


@pytest.mark.parametrize("rgb_name", ["IMG_{}", "T1{}"])
def test_a_folder_of_both_cameras_may_be_called_thermal(photos, rgb_name):
    thermal = {f"thermal 1/T{i}.tif": ("celsius", at(60 * i)) for i in range(4)}
    rgb = {f"thermal 1/{rgb_name.format(i)}.jpg": ("jpg", at(60 * i)) for i in range(4)}
    root = photos(thermal | rgb)
    found = find_pairs(root)
    assert files(root, found) == list(zip(rgb, thermal, strict=True))


@pytest.mark.parametrize("name", ["{} (1)", "{} - Copy", "{}_copy 2", "{} - Kopie"])
def test_copies_that_a_file_manager_made_add_no_views(photos, name):
    originals = {"rgb/a.jpg": "jpg", "thermal/a.tif": "celsius"}
    copies = {"rgb/{}.jpg".format(name.format("a")): "jpg"}
    root = photos(originals | copies)
    found = find_pairs(root)
    assert files(root, found) == [("rgb/a.jpg", "thermal/a.tif")]
    assert_left_out(found, dict.fromkeys(copies, "copy of rgb/a.jpg"))


@pytest.mark.parametrize(
    "table",
    [
        b"x,y,temperature\n" + b"".join(b"%d,%d,20.5\n" % (i % 4, i // 4) for i in range(16)),
        b"\n".join([b",".join([b"20.5"] * 8)] * 8),
        b"\n".join([b"a setting: yes"] * 120 + [b"20.5," * 20] * 4),
    ],
)
def test_every_table_that_is_read_counts(photos, table):
    root = photos({"rgb/a.jpg": "jpg", "thermal/a.csv": table})
    assert files(root, find_pairs(root)) == [("rgb/a.jpg", "thermal/a.csv")]


@pytest.mark.parametrize(
    "head",
    [
        b"file,lat,lon,alt,a,b,c,d,e",
        b"SourceFile;GPS Latitude;GPS Longitude;b;c;d;e;f;g",
    ],
)
def test_a_list_of_positions_is_no_photo(photos, head):
    rows = [b"IMG_1.tif,46.1,11.2,230,1,2,3,4,5"] * 20
    found = find_pairs(photos({"a.tif": "celsius", "geo.csv": b"\n".join([head, *rows])}))
    assert [pair.photos[THERMAL].name for pair in found.pairs] == ["a.tif"]
    assert_left_out(found, {"geo.csv": "list of positions"})


def test_control_points_are_no_photo(photos):
    root = photos({"thermal/a.png": "png", "gcp.csv": b"Name,X,Y,Z\nP1,3.5,4.5,0.1\n"})
    assert files(root, find_pairs(root)) == [(None, "thermal/a.png")]


def test_arrays_are_thermal_photos_and_other_arrays_are_left_out(photos):
    def npy(array: np.ndarray) -> bytes:
        np.save(file := io.BytesIO(), array)
        return file.getvalue()

    celsius = np.linspace(5, 30, 9 * 12, dtype=np.float32).reshape(9, 12)
    content = {f"rgb/{i}.jpg": "jpg" for i in range(3)}
    content |= {f"thermal/{i}.npy": npy(celsius) for i in range(3)}
    content |= {f"rgb/{i}.npy": npy(celsius) for i in range(3)}  # depths, for instance
    root = photos(content | {"thermal/poses.npy": npy(np.zeros((3, 4, 4)))})
    found = find_pairs(root, PrepareOptions())
    assert files(root, found) == [(f"rgb/{i}.jpg", f"thermal/{i}.npy") for i in range(3)]
    left_out = {f"rgb/{i}.npy": "not thermal by its name" for i in range(3)}
    assert_left_out(found, left_out | {"thermal/poses.npy": "[3, 4, 4]"})


def test_of_several_files_of_a_thermal_photo_alone_the_best_is_used(photos):
    content = {f"{i}_ir.tif": "celsius" for i in range(4)}
    found = find_pairs(photos(content | {f"{i}_ir_color.jpg": "jpg" for i in range(4)}))
    assert [pair.photos[THERMAL].name for pair in found.pairs] == [f"{i}_ir.tif" for i in range(4)]
    assert_left_out(found, {f"{i}_ir_color.jpg": "used instead" for i in range(4)})


def test_folders_above_those_of_the_cameras_may_have_any_name(photos):
    root = photos({"Labels/rgb/1.jpg": "jpg", "Labels/thermal/1.png": "png"})
    assert files(root, find_pairs(root)) == [("Labels/rgb/1.jpg", "Labels/thermal/1.png")]


EXTRACTS = {"{}_rgb_image.jpg": "jpg", "{}_thermal.png": "png", "{}_thermal_values.csv": TABLE}


@pytest.mark.parametrize(
    ("originals", "thermal", "skipped"),
    [
        ({}, "{}_thermal_values.csv", ["{}_thermal.png"]),
        ({"{}.jpg": "flir"}, "{}.jpg", ["{}_thermal.png", "{}_thermal_values.csv"]),
        (
            {"{}.jpg": "flir with visible"},
            "{}.jpg",
            ["{}_thermal.png", "{}_thermal_values.csv"],
        ),
    ],
)
def test_what_flirimageextractor_writes(photos, originals, thermal, skipped):
    stems = [f"IR_{number:04d}" for number in range(4)]
    content = EXTRACTS | originals
    root = photos({name.format(stem): what for stem in stems for name, what in content.items()})
    found = find_pairs(root)
    assert files(root, found) == [(f"{s}_rgb_image.jpg", thermal.format(s)) for s in stems]
    assert_left_out(found, {name.format(s): "used instead" for s in stems for name in skipped})


@pytest.mark.parametrize(
    ("content", "pair"),
    [
        (
            {"1_rgb.png": "png", "1_thermal_raw.tif": "celsius", "1_thermal_color.png": "png"},
            ("1_rgb.png", "1_thermal_raw.tif"),
        ),
        (
            {"DJI_0001_W.JPG": "jpg", "DJI_0001_T.JPG": "dji", "DJI_0001_T_celsius.tif": "celsius"},
            ("DJI_0001_W.JPG", "DJI_0001_T_celsius.tif"),
        ),
        ({"DJI_0001_W.JPG": "jpg", "DJI_0001_T_temp.tif": "celsius"}, None),
        ({"rgb/1.png": "png", "thr/1.png": "png"}, None),
        (
            {
                "rgb/1.png": ("jpg", {"size": (24, 20)}),
                "thermal/1.tif": "celsius",
                "depth/1.tif": "celsius",
                "labels/1.png": "png",
                "rgb/1_mask.png": "png",
            },
            ("rgb/1.png", "thermal/1.tif"),
        ),
    ],
)
def test_files_beside_the_photos(photos, content, pair):
    root = photos(content)
    assert files(root, find_pairs(root)) == [pair or tuple(content)]


def test_numbers_that_a_picture_of_their_name_stands_for_are_said(photos):
    content = {f"rgb/{i}.jpg": ("jpg", {"size": (24, 20)}) for i in range(3)}
    content |= {f"thermal/{i}.png": "png" for i in range(3)}
    found = find_pairs(photos(content | {f"degrees/{i}.tif": "celsius" for i in range(3)}))
    assert any("degrees/0.tif holds numbers" in text for text in found.warnings)


@pytest.mark.parametrize("form", ["{:.6f}", "frame_{:.3f}", "{:.0f}"])
def test_names_in_seconds_since_1970_are_times(photos, form):
    """Of a robot's two cameras, at 4 and 3 images a second."""
    scale = {"{:.0f}": 1e9}.get(form, 1.0)
    start = 1_700_000_000.123

    def name(seconds: float) -> str:
        return form.format((start + seconds) * scale)

    rgb = [f"rgb/{name(number / 4)}.png" for number in range(12)]
    thermal = [f"thermal/{name(number / 3 + 0.01)}.png" for number in range(9)]
    root = photos(dict.fromkeys(rgb + thermal, "png"))
    found = find_pairs(root)
    nearest = [round((number / 3 + 0.01) * 4) for number in range(9)]
    assert files(root, found) == [(rgb[at], one) for at, one in zip(nearest, thermal, strict=True)]
    assert "within" in found.rule


def test_numbers_that_cannot_be_seconds_are_no_times(photos):
    names = ["1000012345", "20230101120000", "1234567890", "17000000001", "1700000000_4567"]
    root = photos({f"{folder}/{name}.png": "png" for name in names for folder in ("rgb", "ir")})
    assert [photo.exif.taken for photo in take_inventory(root).photos] == [None] * 10


def test_previews_of_other_names_are_no_rgb_photos(photos):
    content = {"thermal/1.tif": "celsius", "thermal/1_preview.jpg": "jpg"}
    root = photos(content | {"thermal/2.tif": "celsius", "thermal/2_preview.jpg": "jpg"})
    found = find_pairs(root)
    assert all(pair.photos.keys() == {THERMAL} for pair in found.pairs)


def test_the_best_of_several_thermal_files(photos):
    root = photos(
        {
            "a.jpg": "flir",
            "a.csv": TABLE,
            "a_rgb.jpg": "jpg",
            "b.tif": "celsius",
            "b_8b.jpg": "png",
            "b_rgb.jpg": "jpg",
        }
    )
    found = find_pairs(root)
    assert files(root, found) == [("a_rgb.jpg", "a.jpg"), ("b_rgb.jpg", "b.tif")]
    assert_left_out(found, {"a.csv": "taken from a.jpg", "b_8b.jpg": "b.tif is used"})


def test_the_wide_photos_are_preferred(photos):
    content = {f"DJI_000{i}_{mark}.JPG": "jpg" for i in (1, 2) for mark in "TWZ"}
    content["DJI_0003_T.JPG"] = content["DJI_0003_Z.JPG"] = "jpg"
    del content["DJI_0002_Z.JPG"]
    root = photos(content)
    found = find_pairs(root)
    assert files(root, found) == [(f"DJI_000{i}_W.JPG", f"DJI_000{i}_T.JPG") for i in (1, 2)]
    assert_left_out(
        found,
        {
            "DJI_0001_Z.JPG": "DJI_0001_W.JPG is used",
            "DJI_0003_T.JPG": "no RGB photo",
            "DJI_0003_Z.JPG": "no thermal photo",
        },
    )


def test_one_lens_in_folders_too(photos):
    content = {f"thermal/DJI_000{i}_T.JPG": "jpg" for i in (1, 2, 3)}
    content |= {f"rgb/DJI_000{i}_W.JPG": "jpg" for i in (1, 2)} | {
        f"rgb/DJI_000{i}_Z.JPG": "jpg" for i in (1, 3)
    }
    assert [pair.photos[RGB].name for pair in find_pairs(photos(content)).pairs] == [
        "DJI_0001_W.JPG",
        "DJI_0002_W.JPG",
    ]


def test_names_are_surer_than_neighbouring_numbers(photos):
    """Two photos are missing, so that neighbours make one pair more than names do."""
    content = {f"DJI_{i:04d}_T.JPG": "jpg" for i in range(1, 10)} | {
        f"DJI_{i:04d}_W.JPG": "jpg" for i in range(2, 11, 2)
    }
    found = find_pairs(photos(content))
    assert [pair.name for pair in found.pairs] == [f"DJI_{i:04d}" for i in (2, 4, 6, 8)]


def test_numbers_that_start_again(photos):
    stamps = ("20230101120000", "20230101150000")
    root = photos({f"DJI_{stamp}_0001_{mark}.JPG": "jpg" for stamp in stamps for mark in "TW"})
    found = find_pairs(root)
    assert [pair.name for pair in found.pairs] == ["DJI_0001", "DJI_0001_2"]
    assert all(
        pair.photos[RGB].name == pair.photos[THERMAL].name.replace("_T", "_W")
        for pair in found.pairs
    )


@pytest.mark.parametrize("name", ["card", "thermal"])
def test_thermal_photos_alone(photos, name):
    files_ = (
        {"thermal/1.png": "png", "thermal/2.png": "png"}
        if name == "card"
        else {"1.png": "png", "2.png": "png"}
    )
    root = photos(files_, name)
    found = find_pairs(root)
    assert files(root, found) == [(None, path) for path in files_]
    assert "Only the thermal" in found.rule
    assert found.warnings == ()


def test_thermal_photos_alone_although_there_are_others(photos):
    """Visible photos taken in the dark are of no use, neither beside nor inside."""
    root = photos(
        {
            "IR_1.jpg": "flir with visible",
            "DC_2.jpg": "jpg",
            "IR_3.jpg": "flir with visible",
            "IR_5.jpg": "flir",
        }
    )
    found = find_pairs(root, PrepareOptions(pairs="thermal"))
    assert files(root, found) == [(None, "IR_1.jpg"), (None, "IR_3.jpg"), (None, "IR_5.jpg")]
    assert not any(pair.embedded for pair in found.pairs)
    assert "Only the thermal" in found.rule
    assert found.warnings == ()
    assert_left_out(found, {"DC_2.jpg": "only the thermal"})


@pytest.mark.parametrize(
    "names", [("rgb/Küche 0.jpg", "thermal/Küche 0.png"), ("Küche_rgb.jpg", "Küche_thermal.png")]
)
def test_names_in_both_unicode_forms(photos, names):
    """A Mac and a PC write the same name differently."""
    rgb, thermal = unicodedata.normalize("NFC", names[0]), unicodedata.normalize("NFD", names[1])
    root = photos({rgb: "jpg", thermal: "png"})
    found = find_pairs(root)
    assert files(root, found) == [(rgb, thermal)]


@pytest.mark.skipif(sys.platform != "linux", reason="other systems allow no such names")
def test_names_that_are_no_utf8_can_be_printed(photos):
    """Each by the bytes that are no text, so that they do not look the same."""
    odd = [os.fsdecode(name) for name in (b"K\xfcche", b"K\xf6che")]
    root = photos(
        {f"{name}_{mark}.jpg": "jpg" for name in odd for mark in ("rgb", "wide", "thermal")}
    )
    root = photos({f"{odd[0]}.srt": b"x"})
    found = find_pairs(root)
    assert sorted(pair.photos[THERMAL].name for pair in found.pairs) == sorted(
        f"{name}_thermal.jpg" for name in odd
    )
    first, second = (rf"K\udc{byte}che" for byte in ("f6", "fc"))
    assert found.rule.endswith(f", such as {first}_wide.jpg and {first}_thermal.jpg.")
    reasons = {item.name: item.reason for item in found.skipped}
    assert reasons.keys() == {f"{second}.srt", f"{first}_rgb.jpg", f"{second}_rgb.jpg"}
    for name in (first, second):
        assert f"{name}_wide.jpg" in reasons[f"{name}_rgb.jpg"]


def test_a_few_other_photos_do_not_make_pairs(photos):
    content = {f"{i}.jpg": "flir" for i in range(8)} | {
        "7.jpg": "flir with visible",
        "team.jpg": "jpg",
    }
    found = find_pairs(photos(content))
    assert len(found.pairs) == 8
    assert not any(pair.embedded for pair in found.pairs)
    assert "8 thermal" in found.warnings[0]
    assert "2 RGB" in found.warnings[0]
    assert_left_out(found, {"team.jpg": "no RGB photo"})


def test_hidden_files_do_not_count_and_others_are_listed(photos):
    content = {
        "rgb/1.jpg": "jpg",
        "thermal/1.png": "png",
        ".DS_Store": b"x",
        "rgb/._1.jpg": b"x",
        "log.srt": b"x",
    }
    root = photos({**content, "sub/2.heic": b"x"})
    os.symlink(root / "sub", root / "again")
    assert_left_out(
        find_pairs(root), {"again": "link", "log.srt": "not a photo", "sub/2.heic": "JPEG or PNG"}
    )


def test_zoomed_photos_are_told(photos):
    rgb = {
        f"rgb/{i}.jpg": ("jpg", {"focal_mm": focal}) for i, focal in enumerate((24.0, 24.1, 70.0))
    }
    found = find_pairs(photos(rgb | {f"thermal/{i}.png": "png" for i in range(3)}))
    assert "RGB" in found.warnings[0]
    assert "24 mm to 70 mm" in found.warnings[0]


def test_zoomed_thermal_photos_are_told(photos):
    thermal = {f"thermal/{i}.png": ("jpg", {"focal_mm": 9.0 * (1 + i)}) for i in range(2)}
    found = find_pairs(photos(thermal | {f"rgb/{i}.jpg": "jpg" for i in range(2)}))
    (warning,) = found.warnings
    assert "thermal" in warning
    assert "9 mm to 18 mm" in warning


def test_two_cameras_of_one_model_are_told(photos):
    own = {i: FlirPhoto(info_fields={0x104: b"4712"} if i == 2 else {}).jpeg() for i in range(3)}
    found = find_pairs(photos({f"{i}.jpg": own[i] for i in own}))
    (warning,) = found.warnings
    for told in ("thermal", "2 cameras", "4711 (2, such as 0.jpg)", "4712 (1, such as 2.jpg)"):
        assert told in warning


def test_two_cameras_by_their_exif_data_are_told(photos):
    def rgb(serial: str) -> bytes:
        facts = Image.Exif()
        facts.get_ifd(0x8769)[0xA431] = serial
        return jpg(np.zeros((8, 8, 3), np.uint8), exif=facts)

    content = {"rgb/0.jpg": rgb("17"), "rgb/1.jpg": rgb("18")}
    found = find_pairs(photos(content | {f"thermal/{i}.png": "png" for i in range(2)}))
    for told in ("RGB", "2 cameras", "17 (1, such as rgb/0.jpg)", "18 (1, such as rgb/1.jpg)"):
        assert told in found.warnings[0]


def with_view(view_deg: float) -> bytes:
    return FlirPhoto(info_fields={0x1B4: struct.pack("<f", view_deg)}).jpeg()


def test_one_lens_at_two_focuses_is_one_lens(photos):
    assert find_pairs(photos({"a.jpg": with_view(25.0), "b.jpg": with_view(26.0)})).warnings == ()


@pytest.mark.parametrize("word", ["time", "auto"])
def test_the_times_in_flirs_own_files_count(photos, word):
    taken = datetime(2013, 3, 12, 16, 31, 23)  # the record's
    content = {
        f"t/IR{i}x.fff": FlirPhoto(
            info_fields={0x384: struct.pack("<I", 1_363_105_883 + 60 * i)}
        ).record()
        for i in range(3)
    }
    content |= {
        f"c/{9 - i}.jpg": ("jpg", {"taken": taken + timedelta(seconds=60 * i)}) for i in range(3)
    }
    found = find_pairs(photos(content), PrepareOptions(pairs=word))
    assert [(pair.photos[RGB].name, pair.photos[THERMAL].name) for pair in found.pairs] == [
        (f"{9 - i}.jpg", f"IR{i}x.fff") for i in range(3)
    ]


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (
            {"a.jpg": with_view(25.0), "b.jpg": with_view(45.0), "c.jpg": with_view(25.0)},
            ["card", "thermal", "25° such as a.jpg", "45° such as b.jpg"],
        ),
        ({}, ["card", "no photos"]),
        ({"a.mp4": b"x"}, ["none of its 1 files", "a.mp4"]),
        ({"a.jpg": "jpg", "b.jpg": "jpg"}, ["none of its 2 photos", "thermal"]),
        ({"a.jpg": "flir", "b.jpg": "jpg"}, ["1 thermal", "1 other", "no pairs"]),
        (
            {
                f"{c}/{i}.jpg": ("jpg", {"model": f"M{i % 3}"})
                for c in ("rgb", "thermal")
                for i in range(5)
            },
            ["card", "RGB", "3 cameras", "2 of M0", "rgb/0.jpg", "2 of M1", "1 of M2", "rgb/2.jpg"],
        ),
        (
            {
                "rgb/1.jpg": "jpg",
                "rgb/2.jpg": "jpg",
                "thermal/1.png": "png",
                "thermal/2.png": ("png", {"size": (8, 6)}),
            },
            ["thermal photos", "2 cameras", "16 x 12", "thermal/1.png", "8 x 6", "thermal/2.png"],
        ),
    ],
)
def test_sets_that_cannot_be_used(photos, content, told):
    with pytest.raises(SceneError) as refusal:
        find_pairs(photos(content))
    assert [fact for fact in told if fact not in str(refusal.value)] == []


@pytest.mark.parametrize(
    ("rule", "content", "message"),
    [
        ("thermal", {"a.jpg": "jpg", "b.jpg": "jpg"}, "known to be thermal"),
        ("names", {"rgb/1.jpg": "jpg", "t/2.tif": "celsius"}, "camera suffix"),
        ("folders", {"rgb/1.jpg": "jpg", "t/2.tif": "celsius"}, "equal names"),
        ("time", {"rgb/1.jpg": "jpg", "t/1.tif": "celsius"}, "the thermal photos do not"),
        ("time", {"rgb/1.jpg": "jpg", "t/1.tif": ("celsius", at(0))}, "the other photos do not"),
        ("time", {"rgb/1.jpg": ("jpg", at(9)), "t/1.tif": ("celsius", at(0))}, "within 2 s"),
    ],
)
def test_rules_that_do_not_fit(photos, rule, content, message):
    with pytest.raises(SceneError, match=message):
        find_pairs(photos(content), PrepareOptions(pairs=rule))


def test_a_folder_that_is_none(tmp_path):
    with pytest.raises(SceneError, match="nothing: not a folder"):
        find_pairs(tmp_path / "nothing")


@pytest.mark.parametrize("tolerance_s", [-1.0, float("nan"), float("inf")])
def test_a_tolerance_that_is_no_time(tmp_path, tolerance_s):
    with pytest.raises(ConfigError, match="time difference"):
        find_pairs(tmp_path, PrepareOptions(tolerance_s=tolerance_s))


FOLDERS = st.sampled_from(["", "rgb/", "thermal/", "IR/100/", "x/"])
STEMS = st.sampled_from(
    ["1", "2", "a_rgb", "a_t", "DJI_0001_T", "DJI_0001_W", "DJI_0001_Z", "IR_3", "DC_4"]
)
STEMS |= st.sampled_from(
    ["DJI_20230101120000_0001_T", "DJI_20230101120001_0001_W", "DJI_20230101120300_0001_T"]
)
SUFFIXES = st.sampled_from([".jpg", ".jpg", ".jpg", ".png", ".tif", ".txt"])
NAMES = st.builds(lambda folder, stem, suffix: f"{folder}{stem}{suffix}", FOLDERS, STEMS, SUFFIXES)


@settings(max_examples=25)
@given(names=st.lists(NAMES, max_size=10, unique=True), data=st.data())
def test_every_file_is_in_one_pair_or_left_out(names, data):
    """One to one, nothing lost, and the same in whatever order the system lists the files."""
    kinds = {
        ".jpg": ["jpg", "jpg", "jpg", "flir", "flir with visible"],
        ".png": ["png"],
        ".tif": ["celsius"],
        ".txt": [b"text"],
    }
    chosen = {name: data.draw(st.sampled_from(kinds[name[-4:]])) for name in names}
    seconds = {name: data.draw(st.sampled_from([None, 0, 1, 2, 5, 3600])) for name in names}
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for name, kind in chosen.items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            taken = None if seconds[name] is None else NOON + timedelta(seconds=seconds[name])
            (root / name).write_bytes(kind if isinstance(kind, bytes) else photo(kind, taken=taken))
        try:
            found = find_pairs(root)
        except SceneError:
            return
        used = [
            path.relative_to(root).as_posix()
            for pair in found.pairs
            for path in pair.photos.values()
            if path
        ]
        assert sorted([*used, *reasons(found)]) == sorted(names)
        assert len({pair.name.lower() for pair in found.pairs}) == len(found.pairs)
        assert len({(RGB in pair.photos, pair.embedded) for pair in found.pairs}) == 1
        with pytest.MonkeyPatch.context() as patch:
            walk = os.walk
            patch.setattr(os, "walk", lambda *args, **more: shuffled(walk(*args, **more)))
            assert find_pairs(root) == found


def shuffled(walked):
    """What ``os.walk`` gives, in another order."""
    order = random.Random(1)
    for parent, folders, names in walked:
        order.shuffle(folders)
        order.shuffle(names)
        yield parent, folders, names


def test_the_headers_of_unchanged_files_are_read_once(photos):
    """What was read before is the same object, and not merely equal: the facts of the header."""
    root = photos({"a_rgb.jpg": "jpg", "a_thermal.tif": "celsius"})
    steps = []
    rgb, thermal = take_inventory(root, lambda *step: steps.append(step)).photos
    assert steps == [("reading headers", 0, 2), ("reading headers", 1, 2)]
    again = take_inventory(root).photos
    assert again[0] == rgb
    assert again[0].exif is rgb.exif
    assert again[1] == thermal
    assert again[1].exif is thermal.exif
    (root / "a_rgb.jpg").write_bytes(photo("jpg", size=(32, 12)))
    changed, same = take_inventory(root).photos
    assert changed.size == (32, 12)
    assert same == thermal
    assert same.exif is thermal.exif


MIXED = {
    **{f"DJI_000{i}_T.tiff": ("celsius", {"model": "M3T"}) for i in range(4)},
    **{f"DJI_000{i}_W.JPG": ("jpg", {"model": "M3T"}) for i in range(4)},
    **{f"FLIR{i}.jpg": ("flir with visible", {"model": "FLIR E8"}) for i in range(3)},
    "stray.tiff": ("celsius", {"model": "Testo 885"}),
}
"""Two cameras whose pairs different rules find, and one thermal photo of a third."""


def test_several_cameras_are_named_whatever_rule_finds_their_pairs(photos):
    with pytest.raises(SeveralCamerasError, match="M3T") as refusal:
        find_pairs(photos(MIXED))
    assert refusal.value.cameras == ("M3T", "FLIR E8"), "not the one with too few photos"
    assert refusal.value.options == ("camera",)


@pytest.mark.parametrize(
    ("camera", "names"),
    [
        ("M3T", ["DJI_0000", "DJI_0001", "DJI_0002", "DJI_0003"]),
        ("FLIR E8", ["FLIR0", "FLIR1", "FLIR2"]),
    ],
)
def test_the_photos_of_one_camera_are_used_alone(photos, camera, names):
    root = photos(MIXED)
    found = find_pairs(root, PrepareOptions(camera=camera))
    assert [pair.name for pair in found.pairs] == names
    assert all(pair.embedded or RGB in pair.photos for pair in found.pairs)
    assert camera in reasons(found)["stray.tiff"]
    assert len(found.pairs) * (1 if camera == "FLIR E8" else 2) + len(found.skipped) == len(MIXED)


def test_a_camera_that_took_no_photo_is_told_with_those_that_did(photos):
    with pytest.raises(SceneError, match="E9") as refusal:
        find_pairs(photos(MIXED), PrepareOptions(camera="E9"))
    assert [name for name in ("M3T", "FLIR E8", "Testo") if name not in str(refusal.value)] == []
    assert refusal.value.options == ("camera",)


def test_photos_that_name_no_camera_are_of_the_only_one_with_their_size(photos):
    sizes = {"M3T": (8, 6), "E8": (16, 12), "H20T": (16, 12)}
    content = {
        f"{model}{i}.tiff": ("celsius", {"model": model, "size": size})
        for model, size in sizes.items()
        for i in range(3)
    }
    bare = {"a": (8, 6), "b": (16, 12), "c": (32, 24)}
    content |= {f"{name}.tiff": ("celsius", {"size": size}) for name, size in bare.items()}
    root = photos(content)
    options = (PrepareOptions(pairs="thermal", camera=name) for name in ("M3T", "E8"))
    small, large = (find_pairs(root, each) for each in options)
    assert [pair.name for pair in small.pairs] == ["a", "M3T0", "M3T1", "M3T2"]
    assert reasons(small)["b.tiff"] == "is not of M3T"
    assert any("1 thermal photo" in text and "c.tiff" in text for text in small.warnings)
    assert [pair.name for pair in large.pairs] == ["E80", "E81", "E82"]
    assert any("2 thermal photos" in text for text in large.warnings)
    assert "camera" in reasons(large)["b.tiff"]


def test_a_camera_that_was_chosen_is_not_asked_for_again(photos):
    content = {
        f"{model}{i}.tiff": ("celsius", {"model": model, "size": (8, 6) if i % 2 else (16, 12)})
        for model in ("M3T", "E8")
        for i in range(6)
    }
    with pytest.raises(SceneError, match="16 x 12") as refusal:
        find_pairs(photos(content), PrepareOptions(camera="M3T"))
    assert refusal.value.options == ()


def test_one_camera_may_be_named_too(photos):
    content = {name: kind for name, kind in MIXED.items() if name.startswith("DJI")}
    assert len(find_pairs(photos(content), PrepareOptions(camera="M3T")).pairs) == 4


def test_a_table_of_several_cameras_is_cut_to_one(photos):
    root = photos(MIXED)
    table = root.parent / "pairs.csv"
    rows = [f"DJI_000{i}_W.JPG,DJI_000{i}_T.tiff" for i in range(4)] + [
        f",FLIR{i}.jpg" for i in range(3)
    ]
    table.write_text("\n".join(["rgb,thermal", *rows]), encoding="utf-8")
    found = find_pairs(root, PrepareOptions(pair_table=table, camera="FLIR E8"))
    assert [pair.name for pair in found.pairs] == [
        "FLIR0", "FLIR1", "FLIR2",
    ]  # fmt: skip


@pytest.mark.parametrize("name", ["16 x 12", "8 x 6"])
def test_sizes_and_lenses_tell_cameras_of_one_model_apart(photos, name):
    sizes = {f"{i}.tiff": ("celsius", {"size": (8, 6) if i < 3 else (16, 12)}) for i in range(6)}
    with pytest.raises(SeveralCamerasError, match=name):
        find_pairs(photos(sizes))
    assert len(find_pairs(photos(sizes, name), PrepareOptions(camera=name)).pairs) == 3


def test_lenses_are_chosen_by_their_angle(photos):
    root = photos({f"{i}.jpg": with_view(25.0 + i % 2 + 20 * (i > 3)) for i in range(8)})
    with pytest.raises(SeveralCamerasError) as refusal:
        find_pairs(root)
    assert refusal.value.cameras == ("25°", "45°")
    found = find_pairs(root, PrepareOptions(camera="45°"))
    assert [pair.name for pair in found.pairs] == ["4", "5", "6", "7"]


TRIMMED = range(2, 22)
"""Numbers of photos in turns, thermal odd, without the first thermal and the last RGB photo."""


def in_turns(numbers: Iterable[int], options: Callable[[int], dict]) -> dict[str, object]:
    names = {n: f"IR_{n:04d}.jpg" if n % 2 else f"DC_{n:04d}.jpg" for n in numbers}
    return {name: ("flir" if n % 2 else "jpg", options(n)) for n, name in names.items()}


@pytest.mark.parametrize("gap_s", [0, 1])
def test_of_photos_in_turns_those_of_one_moment_are_a_pair(photos, gap_s):
    root = photos(in_turns(TRIMMED, lambda n: at((n - 1) // 2 * 5 + gap_s * (n % 2 == 0))))
    found = find_pairs(root)
    assert files(root, found) == [
        (f"DC_{n + 1:04d}.jpg", f"IR_{n:04d}.jpg") for n in range(3, 20, 2)
    ]
    assert found.warnings == ()


def test_photos_in_turns_without_times_are_doubted_where_the_first_may_be_missing(photos):
    found = find_pairs(photos(in_turns(TRIMMED, lambda n: {})))
    assert "previous" in found.rule
    assert any("may be missing" in text for text in found.warnings)
    whole = in_turns(range(1, 21), lambda n: {})
    assert find_pairs(photos(whole, "whole")).warnings == ()


@pytest.mark.parametrize(
    ("rgb", "thermal"),
    [("{}_rgb", "{}_thermal"), ("rgb{}", "thermal{}"), ("RGB_flight{}", "Thermal_flight{}")],
)
def test_two_surveys_stay_apart_by_the_rest_of_their_folders_names(photos, rgb, thermal):
    lacking = {("1", 2), ("1", 3)}
    places = [(survey, i) for survey in "12" for i in range(6)]
    when = {(survey, i): at(1000 * int(survey) + 10 * i) for survey, i in places}
    content = {f"{thermal.format(s)}/IMG_{i}.tif": ("celsius", when[s, i]) for s, i in places}
    content |= {
        f"{rgb.format(s)}/IMG_{i}.jpg": ("jpg", when[s, i])
        for s, i in places
        if (s, i) not in lacking
    }
    root = photos(content)
    assert set(files(root, find_pairs(root))) == {
        (f"{rgb.format(s)}/IMG_{i}.jpg", f"{thermal.format(s)}/IMG_{i}.tif")
        for s, i in places
        if (s, i) not in lacking
    }


@pytest.mark.parametrize(
    ("preview", "numbers"),
    [
        *(("thermal/{}.jpg", f"thermal/{{}}{end}.tif") for end in ("_temperature", "_raw", "_T")),
        ("thermal/{}.jpg", "thermal_tiff/{}.tif"),
        ("thermal/jpg/{}.jpg", "thermal/tiff/{}.tif"),
        ("thermal/{}.jpg", "csv/{}.csv"),
    ],
)
def test_a_preview_is_neither_the_rgb_photo_nor_used_for_the_numbers(photos, preview, numbers):
    stems = [f"{number:04d}" for number in range(8)]
    content = {f"rgb/{stem}.jpg": "jpg" for stem in stems}
    content |= {preview.format(stem): ("jpg", {"size": (24, 20)}) for stem in stems}
    what = TABLE if numbers.endswith("csv") else "celsius"
    root = photos(content | {numbers.format(stem): what for stem in stems})
    found = find_pairs(root)
    assert files(root, found) == [(f"rgb/{s}.jpg", numbers.format(s)) for s in stems]
    assert_left_out(found, {preview.format(s): "the temperatures are taken from" for s in stems})


@pytest.mark.parametrize("mark", ["VL", "visual", "DC", "EO", "optical"])
def test_an_rgb_mark_goes_before_the_picture_without_one(photos, mark):
    content = {f"IMG_{i}.jpg": "jpg" for i in range(4)} | {f"IMG_{i}.csv": TABLE for i in range(4)}
    root = photos(content | {f"IMG_{i}_{mark}.jpg": "jpg" for i in range(4)})
    assert files(root, find_pairs(root)) == [
        (f"IMG_{i}_{mark}.jpg", f"IMG_{i}.csv") for i in range(4)
    ]


@pytest.mark.parametrize(("rgb", "thermal"), [("MAX_{}", "IRX_{}"), ("DJI_{}_V", "DJI_{}_T")])
def test_names_of_both_cameras_go_before_the_name_of_their_folder(photos, rgb, thermal):
    folder = "thermal flight"
    content = {f"{folder}/{thermal.format(f'{i:04d}')}.jpg": "jpg" for i in range(4)}
    big = ("jpg", {"size": (80, 60)})
    root = photos(content | {f"{folder}/{rgb.format(f'{i:04d}')}.jpg": big for i in range(4)})
    assert [name for name, _ in files(root, find_pairs(root))] == [
        f"{folder}/{rgb.format(f'{i:04d}')}.jpg" for i in range(4)
    ]


def test_a_table_about_the_images_leaves_their_folder_its_name(photos):
    content = {f"thermal/{i}.png": "png" for i in range(10)}
    root = photos(content | {f"rgb/{i}.jpg": "jpg" for i in range(10)} | {"thermal/log.csv": TABLE})
    assert len(find_pairs(root).pairs) == 10
