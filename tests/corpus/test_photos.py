from __future__ import annotations

from datetime import datetime, timedelta

import numpy as np
import pytest
from PIL import Image

from mrgs.data.radiometric import Overrides, read_exif, read_thermal_photo
from mrgs.data.radiometric.exif import _facts
from mrgs.errors import SceneError
from mrgs.prepare.options import PrepareOptions
from mrgs.prepare.pairs.find import find_pairs
from mrgs.scene import RGB, THERMAL
from tests.corpus.photos import numbers, places, raw_photo, timed_jpeg, with_parts_reversed
from tests.helpers.flir import PARAMETERS, FlirPhoto, wave

Y, X = np.mgrid[:30, :40]
TABLE_C = np.round(18 + 6 * np.sin(X / 9) + Y / 10, 1)


def cells(values: np.ndarray, decimal: str = ".") -> list[list[str]]:
    return [[f"{value:.1f}".replace(".", decimal) for value in row] for row in values]


def joined(rows: list[list[str]], separator: str = ";") -> str:
    return "".join(separator.join(row) + "\n" for row in rows)


def with_gaps(*places) -> np.ndarray:
    expected = TABLE_C.copy()
    for place in places:
        expected[place] = np.nan
    return expected


def read(tmp_path, text: str):
    (tmp_path / "a.csv").write_text(text)
    return read_thermal_photo(tmp_path / "a.csv").temperature_c


@pytest.mark.parametrize("head", ["", "Emissivity,0,95\n", "sep=,\n"])
@pytest.mark.parametrize("label", ["", "Frame 1,"])
def test_commas_between_numbers_and_in_them(tmp_path, head, label):
    text = numbers(TABLE_C, ",", ",")
    lines = "".join(f"{label}{line}\n" for line in text.splitlines())
    np.testing.assert_allclose(read(tmp_path, head + lines), TABLE_C, atol=1e-5)


@pytest.mark.parametrize("gap", ["nan", "", "--"])
@pytest.mark.parametrize("is_indexed", [False, True])
@pytest.mark.parametrize("separator", [",", ", "])
def test_commas_between_numbers_and_in_them_with_gaps(tmp_path, gap, is_indexed, separator):
    rows = cells(TABLE_C, ",")
    rows[12][7], rows[20] = gap, [gap] * 40
    lines = [[str(y), *row] if is_indexed else row for y, row in enumerate(rows)]
    expected = with_gaps((12, 7), 20)
    np.testing.assert_allclose(read(tmp_path, joined(lines, separator)), expected, atol=1e-5)


@pytest.mark.parametrize("lacking", [1, 3])
def test_a_few_numbers_without_decimals_make_no_wider_picture(tmp_path, lacking):
    text = numbers(TABLE_C, ",", ",").replace(",0,", ",", lacking)
    (tmp_path / "a.csv").write_text(text)
    photo = read_thermal_photo(tmp_path / "a.csv")
    assert photo.valid.shape[1] == 40
    assert "left out" in photo.facts.warnings[0]


def test_whole_degrees_between_commas_stay_whole(tmp_path):
    whole = np.rint(TABLE_C)
    text = "\n".join(",".join(f"{value:.0f}" for value in row) for row in whole)
    np.testing.assert_array_equal(read(tmp_path, text), whole)


@pytest.mark.parametrize("digits", [1, 2, 3])
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("label", ["", "1.5,"])
def test_whole_numbers_among_those_with_a_point_stay_whole(tmp_path, digits, seed, label):
    """As R, Excel and many programs write: without zeros at the end."""
    steps = np.random.default_rng(seed).normal(0, 0.05, (120, 160)).cumsum(axis=1)
    celsius = np.round(20 + steps, digits)
    text = "".join(label + ",".join(f"{each:g}" for each in row) + "\n" for row in celsius)
    found = read(tmp_path, text)
    np.testing.assert_allclose(found[:, -160:], celsius, atol=1e-5)


def test_a_point_in_a_line_beside_the_table_leaves_decimal_commas(tmp_path):
    heading = "y," + ",".join(f"{i / 10}" for i in range(2 * TABLE_C.shape[1])) + "\n"
    found = read(tmp_path, heading + numbers(TABLE_C, ",", ","))
    np.testing.assert_allclose(found, TABLE_C, atol=1e-5)


@pytest.mark.parametrize(("frames", "pixels"), [(1, 768), (30, 768), (4, 80)])
def test_frames_in_lines_are_no_picture(tmp_path, frames, pixels):
    lines = (",".join(f"{20 + i / 50:.2f}" for i in range(pixels)) + "\n" for _ in range(frames))
    with pytest.raises(SceneError, match="a file for each frame"):
        read(tmp_path, "".join(lines))


def test_a_table_may_be_named_asc(tmp_path):
    (tmp_path / "a.asc").write_text(numbers(TABLE_C, "\t", ","))
    photo = read_thermal_photo(tmp_path / "a.asc")
    np.testing.assert_allclose(photo.temperature_c, TABLE_C, atol=1e-5)


def test_decimals_in_some_of_the_numbers_only_are_refused(tmp_path):
    text = numbers(TABLE_C, ",", ",").replace(",0,", ",")
    with pytest.raises(SceneError, match="no table"):
        read(tmp_path, text)


@pytest.mark.parametrize(
    ("heading", "down_first"),
    [
        ("x,y,t", False),
        ("y,x,temp", True),
        ("row,col,T", True),
        ("Column;Line;°C", False),
        ("x [px],y [px],T [°C]", False),
        ("x/px,y/px,T/°C", False),
        ("X(px),Y(px),Temp", False),
        ("X_pixel,Y_pixel,value", False),
        ("pixel_x,pixel_y,Temperature_C", False),
        ("i,j,T", True),
        ("x,y,temp (c)", True),  # by FlirImageExtractor
        ("Spalte,Zeile,Wert", False),
        ("# xpos,ypos,t", False),
    ],
)
def test_places_and_temperatures_are_a_picture(tmp_path, heading, down_first):
    found = read(tmp_path, places(TABLE_C, heading, down_first))
    np.testing.assert_allclose(found, TABLE_C, atol=1e-5)


@pytest.mark.parametrize(
    ("heading", "line"),
    [
        (",x,y,t", "{i},{x},{y},{t}"),
        ("t,x,y", "{t},{x},{y}"),
        ("x,y,z,t", "{x},{y},0,{t}"),
        ("x [mm];y [mm];T", "{mm};{y};{t}"),
        ("x y t", "{x} {y} {t}"),
    ],
)
def test_places_in_other_columns(tmp_path, heading, line):
    found = read(tmp_path, f"{heading}\n" + "".join(listed(line)))
    np.testing.assert_allclose(found, TABLE_C, atol=1e-5)


def listed(line: str) -> list[str]:
    return [
        line.format(i=i, x=i % 40, y=i // 40, mm=f"{0.33 * (i % 40):.2f}", t=value) + "\n"
        for i, value in enumerate(TABLE_C.ravel())
    ]


def test_places_that_are_missing_or_there_twice(tmp_path):
    lines = listed("{x},{y},{t}")
    chosen = np.sort(np.random.default_rng(0).permutation(1200)[:700])
    expected = np.full(1200, np.nan)
    expected[chosen] = TABLE_C.ravel()[chosen]
    found = read(tmp_path, "x,y,t\n" + "".join(lines[i] + lines[i] for i in chosen))
    np.testing.assert_allclose(found, expected.reshape(30, 40), atol=1e-5)


@pytest.mark.parametrize(
    "text",
    [
        "".join(listed("{x},{y},{t}")),
        "".join(listed("{t},{x},{y}")),
        "".join(listed("{i},{x},{y},{t}")),
        "".join(listed("{x},{y},{t}")[::2]),
        "x,y,t\n" + "".join(listed("{x},{y},{t}")).replace(".", ","),
        "x,y,t\n" + "".join(listed("{x},{y},{t}")) + "3,3,99\n",
        "x,y,t\n" + "".join(listed("{x},{y},{t}")[::40]),
        "x,y,t\n" + "".join(line for line in listed("{x},{y},{t}") if line[:2] != "7,"),
    ],
)
def test_places_that_give_no_picture_are_asked_for(tmp_path, text):
    with pytest.raises(SceneError, match="x, y, t"):
        read(tmp_path, text)


@pytest.mark.parametrize("gap", ["--", ""])
@pytest.mark.parametrize("head", ["", "Emissivity;0.95\n"])
@pytest.mark.parametrize(
    "place", [0, 15, 29, (slice(None), 0), (slice(None), slice(5)), (slice(None), 20)]
)
def test_dead_rows_and_columns_are_masked(tmp_path, gap, head, place):
    expected = with_gaps(place)
    rows = cells(expected)
    text = head + joined([[gap if cell == "nan" else cell for cell in row] for row in rows])
    np.testing.assert_allclose(read(tmp_path, text), expected, atol=1e-5)


def test_a_round_picture_is_masked_outside(tmp_path):
    expected = np.where((Y - 15) ** 2 / 225 + (X - 20) ** 2 / 400 > 1, np.nan, TABLE_C)
    text = joined(cells(expected)).replace("nan", "--")
    np.testing.assert_allclose(read(tmp_path, text), expected, atol=1e-5)


@pytest.mark.parametrize("end", ["\n\n", "\r\r\n"])
def test_empty_lines_between_all_rows(tmp_path, end):
    (tmp_path / "a.csv").write_bytes(joined(cells(TABLE_C)).replace("\n", end).encode())
    found = read_thermal_photo(tmp_path / "a.csv").temperature_c
    np.testing.assert_allclose(found, TABLE_C, atol=1e-5)


@pytest.mark.parametrize("label", ["", "Frame 1;"])
def test_lines_that_a_spreadsheet_pads_are_no_rows(tmp_path, label):
    rows = "".join(f"{label}{line};\n" for line in joined(cells(TABLE_C)).splitlines())
    pad = ";" * (rows.splitlines()[0].count(";") - 1)
    text = f"Emissivity;0.95{pad}\nParameters:;{pad}\n;{pad}\n{rows}"
    np.testing.assert_allclose(read(tmp_path, text), TABLE_C, atol=1e-5)


def test_lines_of_numbers_beside_the_table_are_said(tmp_path):
    (tmp_path / "a.csv").write_text(2 * ("Frame\n" + joined(cells(TABLE_C))))
    photo = read_thermal_photo(tmp_path / "a.csv")
    assert photo.valid.shape == (30, 40)
    assert "left out: 30" in photo.facts.warnings[0]


@pytest.mark.parametrize("corner", ["", "y/x"])
@pytest.mark.parametrize("down", [lambda y: 29 - y, lambda y: 2 * y, lambda y: f"{0.33 * y:.2f}"])
@pytest.mark.parametrize("across", [lambda x: x, lambda x: f"c{x}", lambda x: f"{0.33 * x:.2f}"])
def test_indices_with_a_heading(tmp_path, corner, down, across):
    rows = [[str(down(y)), *row] for y, row in enumerate(cells(TABLE_C))]
    text = joined([[corner, *(str(across(x)) for x in range(40))], *rows])
    np.testing.assert_allclose(read(tmp_path, text), TABLE_C, atol=1e-5)


@pytest.mark.parametrize("down", [lambda y: 29 - y, lambda y: 2 * y, lambda y: f"{0.33 * y:.2f}"])
def test_what_may_be_an_index_is_said(tmp_path, down):
    text = joined([[str(down(y)), *row] for y, row in enumerate(cells(TABLE_C))])
    (tmp_path / "a.csv").write_text(text)
    photo = read_thermal_photo(tmp_path / "a.csv")
    assert "index" in photo.facts.warnings[0]
    np.testing.assert_allclose(photo.temperature_c[:, 1:], TABLE_C, atol=1e-5)


@pytest.mark.parametrize("first", [0, 1, 5])
def test_temperatures_that_rise_by_one_are_no_index(tmp_path, first):
    ramp = X + Y + first
    np.testing.assert_array_equal(read(tmp_path, joined(cells(ramp))), ramp)
    for place in ((slice(None), 0), 0):
        values = TABLE_C.copy()
        values[place] = 5 + np.arange(len(values[place]))
        np.testing.assert_allclose(read(tmp_path, joined(cells(values))), values, atol=1e-5)


@pytest.mark.parametrize(
    ("unit", "separator", "factor", "addend"),
    [(" °C", ";", 1, 0), ("°C", ",", 1, 0), (" °F", ",", 1.8, 32), (" K", " ", 1, 273.15)],
)
def test_units_in_cells(tmp_path, unit, separator, factor, addend):
    rows = [[cell + unit for cell in row] for row in cells(TABLE_C * factor + addend)]
    np.testing.assert_allclose(read(tmp_path, joined(rows, separator)), TABLE_C, atol=0.06)


@pytest.mark.parametrize(
    ("thousands", "decimal", "separator", "quote"),
    [
        (".", ",", ";", ""),
        (",", ".", ",", '"'),
        (".", ",", ",", '"'),
        (" ", ",", ";", ""),
        ("\u202f", ",", "\t", ""),
        ("’", ".", ";", ""),
        ("", ",", ",", "'"),
    ],
)
def test_signs_of_thousands_and_quotes(tmp_path, thousands, decimal, separator, quote):
    hot = 60 * TABLE_C
    signs = str.maketrans({",": thousands, ".": decimal})
    rows = [[f"{quote}{f'{v:,.1f}'.translate(signs)}{quote}" for v in row] for row in hot]
    (tmp_path / "a.csv").write_text("Unit: °C\n" + joined(rows, separator), encoding="utf-8")
    found = read_thermal_photo(tmp_path / "a.csv").temperature_c
    np.testing.assert_allclose(found, hot, atol=0.06)


@pytest.mark.parametrize("minus", ["\u2212", "\u2013"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16-le"])
def test_minus_signs_and_texts_without_a_mark_of_their_encoding(tmp_path, minus, encoding):
    text = joined(cells(TABLE_C - 20)).replace("-", minus)
    (tmp_path / "a.csv").write_bytes(text.encode(encoding))
    found = read_thermal_photo(tmp_path / "a.csv").temperature_c
    np.testing.assert_allclose(found, TABLE_C - 20, atol=1e-5)


@pytest.mark.parametrize(
    ("head", "factor"),
    [("", 100), ("Unit: 0.01K\n", 100), ("Unit;0,01 K\n", 100), ("units [0.04*K]\n", 25)],
)
def test_whole_numbers_of_a_part_of_a_kelvin(tmp_path, head, factor):
    counts = np.rint((TABLE_C + 273.15) * factor).astype(int)
    counts[3, 4] = 65_535
    found = read(tmp_path, head + joined([[str(n) for n in row] for row in counts]))
    np.testing.assert_allclose(found, with_gaps((3, 4)), atol=0.03)


def test_tenths_of_a_degree_may_be_hundredths_and_are_asked_for(tmp_path):
    with pytest.raises(SceneError, match="give the unit"):
        read(tmp_path, joined([[f"{10 * t:.0f}" for t in row] for row in TABLE_C]))


@pytest.mark.parametrize(
    "text",
    [
        numbers(TABLE_C, ";", ",", "sep=;\n"),
        numbers(TABLE_C, ";", ",").replace("\n", ";;\n"),
        numbers(TABLE_C, " "),
        numbers(TABLE_C, "  ", ","),
        "\n".join(" ".join(f"{value:.18e}" for value in row) for row in TABLE_C),
    ],
)
def test_tables_of_spreadsheets_and_of_numpy(tmp_path, text):
    np.testing.assert_allclose(read(tmp_path, text), TABLE_C, atol=1e-5)


@pytest.mark.parametrize("name", ["reflected_c", "atmospheric_c", "window_c"])
@pytest.mark.parametrize("celsius", [25.0, -40.0])
def test_kelvin_that_a_flir_camera_stores_as_celsius(tmp_path, name, celsius):
    settings = {**PARAMETERS, "emissivity": 0.9, "window_transmission": 0.9, name: celsius}
    (tmp_path / "a.jpg").write_bytes(FlirPhoto(parameters=settings).jpeg())
    (tmp_path / "b.jpg").write_bytes(
        FlirPhoto(parameters={**settings, name: celsius + 273.15}).jpeg()
    )
    right, kelvin = (read_thermal_photo(tmp_path / f"{each}.jpg") for each in "ab")
    np.testing.assert_allclose(kelvin.temperature_c, right.temperature_c, atol=1e-3)
    assert any(name in text for text in kelvin.facts.warnings)
    given = read_thermal_photo(tmp_path / "b.jpg", Overrides(**{name: 90.0}))
    assert getattr(given.facts.parameters, name) == 90
    assert not any("are K" in text for text in given.facts.warnings)


def test_parts_of_a_flir_record_in_another_order(tmp_path):
    jpeg = FlirPhoto(raw=wave(60, 80), part_bytes=2000).jpeg()
    for name, data in (("a", jpeg), ("b", with_parts_reversed(jpeg))):
        (tmp_path / f"{name}.jpg").write_bytes(data)
    first, second = (read_thermal_photo(tmp_path / f"{name}.jpg") for name in "ab")
    np.testing.assert_array_equal(first.temperature_c, second.temperature_c)


@pytest.mark.parametrize(
    ("original", "zone", "zone_s"),
    [
        ("2024:05:01 12:00:07", None, None),
        ("2024:05:01 12:00:07", "+02:00", 7200),
        ("2024:05:01 12:00:07", "-03:30", -12600),
        ("2024:05:01 12:00:07+02:00", None, 7200),
        ("2024-05-01T12:00:07Z", None, 0),
        ("2024:05:01 12:00:07.00 -0100", None, -3600),
        ("2024/05/01 12:00:07 UTC", None, 0),
        ("2024: 5: 1 12: 0: 7", None, None),
        ("2024:05:01  12:00:07,00 +02", None, 7200),
        ("2024:05:01 12:00:07 CEST", None, None),
    ],
)
def test_the_time_of_a_photo_with_a_zone_is_that_of_the_photo(original, zone, zone_s):
    found = read_exif(timed_jpeg(original, "2024:11:30 08:00:00", zone))
    assert (found.taken, found.zone_s) == (datetime(2024, 5, 1, 12, 0, 7), zone_s)


def test_a_time_that_cannot_be_read_is_not_that_of_an_edit():
    edited = "2024:11:30 08:00:00"
    assert read_exif(timed_jpeg("2024:05:01 24:00:07", edited)).taken is None
    details = {0x9003: "2024:05:01", 0x9004: "2024:05:01 12:00:07", 0x0132: edited}
    assert _facts(details, {}, 1).taken == datetime(2024, 5, 1, 12, 0, 7)
    for nothing in ("0000:00:00 00:00:00", "    :  :     :  :  ", None):
        assert read_exif(timed_jpeg(nothing, edited)).taken == datetime(2024, 11, 30, 8)


def clock(moment: datetime) -> str:
    return moment.strftime("%Y:%m:%d %H:%M:%S")


NOON = datetime(2024, 5, 1, 12, 0, 0)


def test_photos_that_were_edited_later_are_paired_by_when_they_were_taken(photos):
    files = {}
    for index, second in enumerate((0, 9, 31, 45, 90, 131, 200)):
        taken = NOON + timedelta(seconds=second)
        edited = clock(NOON + timedelta(days=90, seconds=200 - index))
        files[f"rgb/P{index + 3}.jpg"] = (timed_jpeg(f"{clock(taken)}+02:00", edited), {})
        files[f"thermal/T{index}.png"] = ("png", {"taken": taken})
    found = find_pairs(photos(files), PrepareOptions(pairs="time"))
    pairs = [(pair.photos[RGB].stem, pair.photos[THERMAL].stem) for pair in found.pairs]
    assert pairs == [(f"P{index + 3}", f"T{index}") for index in range(7)]


def test_zones_that_both_cameras_know_tell_which_photos_belong_together(photos):
    """At regular intervals times alone cannot tell."""
    files = {}
    for index in range(12):
        taken = NOON + timedelta(seconds=10 * index)
        rgb = timed_jpeg(clock(taken + timedelta(hours=2)), zone="+02:00")
        files[f"rgb/P{index:02d}.jpg"] = (rgb, {})
        files[f"thermal/T{index + 5:02d}.jpg"] = (timed_jpeg(clock(taken), zone="+00:00"), {})
    found = find_pairs(photos(files), PrepareOptions(pairs="time"))
    assert [pair.photos[RGB].stem[1:] for pair in found.pairs] == [f"{i:02d}" for i in range(12)]
    assert found.warnings == ()


@pytest.mark.parametrize("days", [90, -400, 8800])
def test_a_clock_that_is_months_off_or_was_never_set(photos, days):
    files = {}
    for index, second in enumerate((0, 9, 31, 45, 90, 131, 200)):
        taken = NOON + timedelta(seconds=second)
        files[f"rgb/P{index}.jpg"] = ("jpg", {"taken": taken})
        files[f"thermal/T{index}.png"] = ("png", {"taken": taken - timedelta(days=days)})
    found = find_pairs(photos(files), PrepareOptions(pairs="time"))
    assert [pair.photos[RGB].stem[1:] for pair in found.pairs] == list("0123456")
    assert found.warnings == ()


@pytest.mark.parametrize("suffix", [".DNG", ".GPR", ".NEF", ".cr2", ".ERF"])
def test_a_raw_file_beside_its_photo_is_skipped_and_alone_refused(photos, suffix):
    files = {f"{name}_T.tif": "celsius" for name in ("1", "2", "3")}
    files |= {f"{name}_W.JPG": "jpg" for name in ("1", "2", "3")}
    files |= {f"{name}_W{suffix}": (raw_photo(), {}) for name in ("1", "2", "3")}
    found = find_pairs(photos(files))
    assert {pair.photos[RGB].suffix for pair in found.pairs} == {".JPG"}
    assert all("not read" in item.reason for item in found.skipped)
    with pytest.raises(SceneError, match=rf"1_W\{suffix}.*not read"):
        find_pairs(photos({f"1_W{suffix}": (raw_photo(), {})}, "raw"))


def test_colours_that_cannot_be_read_are_missed(photos):
    heic = b"\0\0\0\x18ftypheic" + bytes(40)
    files = {f"thermal/{index}.tif": "celsius" for index in range(3)}
    files |= {f"rgb/{index}.JPG": (heic, {}) for index in range(3)}
    found = find_pairs(photos(files))
    assert all("HEIC" in item.reason for item in found.skipped)
    video = b"\0\0\0\x18ftypmp42" + bytes(40)
    files |= {f"rgb/{index}.JPG": (video, {}) for index in range(3)}
    assert all(item.reason == "is not a photo" for item in find_pairs(photos(files, "b")).skipped)
    assert any("no colours" in warning for warning in found.warnings)


@pytest.mark.parametrize(
    ("rgb", "thermal", "kind"),
    [
        ("MAX_{:04d}.JPG", "MAX_{:04d}_IR.JPG", "jpg"),
        ("MAX_{:04d}.JPG", "IRX_{:04d}.JPG", "jpg"),
        ("{:04d}.JPG", "{:04d}_IR.TIFF", "celsius"),
        ("20240501_{:06d}_VIS.jpg", "20240501_{:06d}_RAD.tiff", "celsius"),
        ("house{:d}b_VIS.jpg", "house{:d}b_RAD.tiff", "celsius"),
        ("HM20240501{:06d}_VL.jpeg", "HM20240501{:06d}.tif", "celsius"),
    ],
)
def test_names_of_makers(photos, rgb, thermal, kind):
    files = {rgb.format(index): ("jpg", {"size": (32, 24)}) for index in range(4)}
    root = photos(files | {thermal.format(index): kind for index in range(4)})
    pairs = [(pair.photos[RGB].name, pair.photos[THERMAL].name) for pair in find_pairs(root).pairs]
    assert pairs == [(rgb.format(index), thermal.format(index)) for index in range(4)]


@pytest.mark.parametrize(
    "lines",
    [
        "{thermal},{rgb}\n",
        "{rgb};{thermal};;\n",
        "{rgb}\t{thermal}\t\n",
        "{thermal}   {rgb}\n",
        "# made by hand\n{thermal},{rgb}\n",
    ],
)
def test_pair_tables_of_spreadsheets_in_either_order(photos, tmp_path, lines):
    files = {f"t/{index}.tif": "celsius" for index in range(3)}
    root = photos(files | {f"v/{index + 4}.jpg": "jpg" for index in range(3)})
    head = "SEP=;\n" if ";" in lines else ""
    table = "".join(lines.format(rgb=f"v/{i + 4}.jpg", thermal=f"t/{i}.tif") for i in range(3))
    (tmp_path / "pairs.csv").write_text(head + table)
    found = find_pairs(root, PrepareOptions(pair_table=tmp_path / "pairs.csv"))
    pairs = [(pair.photos[RGB].name, pair.photos[THERMAL].name) for pair in found.pairs]
    assert pairs == [(f"{i + 4}.jpg", f"{i}.tif") for i in range(3)]


def test_pair_tables_with_further_columns(photos, tmp_path):
    files = {f"t/{index}.tif": "celsius" for index in range(3)}
    root = photos(files | {f"v/{index + 4}.jpg": "jpg" for index in range(3)})
    lines = [f"{index},t/{index}.tif,12:00,v/{index + 4}.jpg" for index in range(3)]
    table = tmp_path / "pairs.csv"
    table.write_text("\n".join(["# id,IR image,time,rgb_path,image_id", *lines]))
    found = find_pairs(root, PrepareOptions(pair_table=table)).pairs
    pairs = [(pair.photos[RGB].stem, pair.name) for pair in found]
    assert pairs == [(f"{index + 4}", f"{index}") for index in range(3)]


def test_a_pair_table_of_plain_photos_follows_their_folders(photos, tmp_path):
    root = photos({f"{at}/{index}.jpg": "jpg" for at in ("ir", "daylight") for index in range(3)})
    table = tmp_path / "pairs.csv"
    table.write_text("".join(f"ir/{index}.jpg,daylight/{index}.jpg\n" for index in range(3)))
    for pair in find_pairs(root, PrepareOptions(pair_table=table)).pairs:
        assert pair.photos[RGB].parent.name == "daylight"
    table.write_text("rgb,thermal\n" + table.read_text())
    for pair in find_pairs(root, PrepareOptions(pair_table=table)).pairs:
        assert pair.photos[RGB].parent.name == "ir"


def test_a_table_separated_by_blanks_is_a_thermal_photo(photos):
    text = numbers(TABLE_C, " ").encode()
    files = {f"{name}_T.txt": (text, {}) for name in "123"}
    files["README.txt"] = (b"ten words in a line make no table of any photo here\n", {})
    root = photos(files | {f"{name}_W.jpg": ("jpg", {"size": (40, 30)}) for name in "123"})
    assert len(find_pairs(root).pairs) == 3


def test_names_in_which_both_photos_have_a_word_of_the_other_camera(photos):
    files = {f"wide_house{index}_rgb.jpg": "jpg" for index in range(3)}
    root = photos(files | {f"wide_house{index}_ir.tif": "celsius" for index in range(3)})
    assert len(find_pairs(root).pairs) == 3


def test_words_in_the_middle_of_names_tell_series_apart(photos):
    names = [f"{lens}_{index:04d}" for lens in ("wide", "zoom") for index in range(4)]
    files = {f"{name}_rgb.jpg": "jpg" for name in names}
    root = photos(files | {f"{name}_ir.tif": "celsius" for name in names})
    assert [pair.name for pair in find_pairs(root).pairs] == names


def test_a_table_may_be_padded_with_empty_cells(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("".join(f"20.5;21.25;{row}.5{';' * 16_000}\n" for row in (20, 21, 22)))
    np.testing.assert_allclose(read_thermal_photo(path).temperature_c[:, 2], [20.5, 21.5, 22.5])


@pytest.mark.parametrize("kelvin_per_count", [0.04, 0.1])
def test_the_unit_of_counts_that_fit_several_is_asked_for(tmp_path, kelvin_per_count):
    """Numbers of 1,000 to 10,000 may be hundredths of a degree, or tenths or fortieths of a K."""
    counts = np.rint((TABLE_C + 273.15) / kelvin_per_count).astype(np.uint16)
    Image.fromarray(counts).save(tmp_path / "a.tiff")
    with pytest.raises(SceneError, match="give the unit"):
        read_thermal_photo(tmp_path / "a.tiff")
    given = read_thermal_photo(
        tmp_path / "a.tiff", Overrides(unit=f"kelvin*{1 / kelvin_per_count:g}")
    )
    np.testing.assert_allclose(given.temperature_c, TABLE_C, atol=0.051)


def test_infinity_between_commas_is_a_pixel_without_temperature(tmp_path):
    found = read(tmp_path, "20,21,22,inf\n20,22,23,24\n20,21,22,25\n")
    assert np.isnan(found[0, 3])
    assert found[1].tolist() == [20, 22, 23, 24]


def test_a_line_about_the_camera_is_no_heading_of_places(tmp_path):
    with pytest.raises(SceneError, match="x, y, t"):
        read(tmp_path, places(TABLE_C, "Camera: VarioCAM, range 2"))
