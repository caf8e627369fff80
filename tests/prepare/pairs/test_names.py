from __future__ import annotations

from datetime import datetime
from pathlib import PurePosixPath

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrgs.prepare.pairs.photo import folder_modality, natural, read_stem, view_names
from mrgs.scene import RGB, THERMAL


@pytest.mark.parametrize(
    ("stem", "key", "modality", "mark"),
    [
        ("DJI_0001_T", "DJI_0001", THERMAL, "t"),
        ("dji_0001_w", "dji_0001", RGB, "w"),
        ("DJI_20230101120000_0001_V", "DJI_0001", RGB, "v"),
        ("DJI_20230101120000_0001_T_Waypoint1", "DJI_0001_Waypoint1", THERMAL, "t"),
        ("DJI_20200101120000_0001_THRM", "DJI_0001", THERMAL, "thrm"),
        ("DJI_0001_ZOOM", "DJI_0001", RGB, "zoom"),
        ("wall_t", "wall", THERMAL, "t"),
        ("house_w", "house_w", None, ""),
        ("IMG0153V", "IMG0153", RGB, "v"),
        ("IR_0001", "0001", THERMAL, "ir"),
        ("ir0001", "0001", THERMAL, "ir"),
        ("DC_0002", "0002", RGB, "dc"),
        ("wall_rgb", "wall", RGB, "rgb"),
        ("wall-Thermal-2", "wall_2", THERMAL, "thermal"),
        ("IR0001_visible", "0001", RGB, "visible"),
        ("thermal_0001_rgb", "0001", RGB, "rgb"),
        ("0001_ir_celsius", "0001", THERMAL, "celsius"),
        ("MAX_0001_IR", "0001", THERMAL, "ir"),
        ("zoom_0001_ir", "zoom_0001", THERMAL, "ir"),
        ("20240131T120000_T", "20240131T120000", THERMAL, "t"),
        ("20240131T120000V", "20240131T120000", RGB, "v"),
        ("ir_20240131T120000Z", "20240131T120000Z", THERMAL, "ir"),
        ("20180101_101010_101_8b", "20180101_101010_101", THERMAL, "8b"),
        ("thermal", "", THERMAL, "thermal"),
        ("FLIR1234", "FLIR1234", None, ""),
        ("frame_train_00001", "frame_train_00001", None, ""),
        ("20180101_101010_101_R", "20180101_101010_101_R", None, ""),
        ("iris_colors", "iris_colors", None, ""),
    ],
)
def test_stems(stem, key, modality, mark):
    facts = read_stem(stem)
    assert (facts.key, facts.modality, facts.mark) == (key, modality, mark)


def test_r_marks_what_is_radiometric():
    assert read_stem("20180101_101010_101_R", radiometric=True).key == "20180101_101010_101"


def test_the_time_in_a_stem():
    assert read_stem("DJI_20230101120001_0001_T").moment == datetime(2023, 1, 1, 12, 0, 1)
    assert read_stem("DJI_20239901120001_0001_T").moment is None


@pytest.mark.parametrize(
    ("folders", "modality", "rest"),
    [
        (["RGB"], RGB, ()),
        (["thermal_images"], THERMAL, ()),
        (["Images"], RGB, ()),
        (["set", "IR", "100MEDIA"], THERMAL, ("set", "100MEDIA")),
        (["DCIM", "100_FLIR"], None, ("DCIM", "100_FLIR")),
        (["FLIR"], THERMAL, ()),
        (["rgb_and_thermal"], None, ("rgb_and_thermal",)),
        (["thermal", "visible"], RGB, ("thermal",)),
    ],
)
def test_folders(folders, modality, rest):
    assert folder_modality(folders) == (modality, rest)


def test_natural_order():
    assert sorted(["a10", "a2", "A1", "b", "10", "9"], key=natural) == [
        "9",
        "10",
        "A1",
        "a2",
        "a10",
        "b",
    ]


@settings(max_examples=30)
@given(st.lists(st.text(max_size=12), max_size=6))
def test_any_texts_can_be_put_in_order(texts):
    backwards = texts[::-1]
    assert sorted(texts, key=natural) == sorted(backwards, key=natural)


@pytest.mark.parametrize(
    ("shots", "names"),
    [
        (["a/x_1", "a/x_2"], ["x_1", "x_2"]),
        (["100/DJI_1", "101/DJI_1"], ["100_DJI_1", "101_DJI_1"]),
        (["Küche #3"], ["Kuche_3"]),
        (["日本"], ["view"]),
        (["con", "../x", "-x."], ["con_", "x", "x"]),
        (["a/X", "b/x", "a_X"], ["a_X", "b_x", "a_X_2"]),
        (["a.jpg"], ["a_jpg"]),
    ],
)
def test_view_names(shots, names):
    found = view_names([PurePosixPath(shot) for shot in shots])
    if len({name.lower() for name in names}) == len(names):
        assert found == names
    assert len({name.lower() for name in found}) == len(found)


@settings(max_examples=30)
@given(st.lists(st.lists(st.text(min_size=1, max_size=8), min_size=1, max_size=3), max_size=8))
def test_view_names_are_unique_and_valid_files(parts):
    shots = [PurePosixPath("x", *(part.replace("/", "_") for part in path)) for path in parts]
    names = view_names(shots)
    assert len({name.lower() for name in names}) == len(shots)
    assert all(
        name and len(name) < 110 and name.isascii() and not set(name) & set('/\\.:*?"<>| \0')
        for name in names
    )
