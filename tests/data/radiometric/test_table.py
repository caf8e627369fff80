"""Tables of temperatures, in the locales that cameras' programs write."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrgs.data.radiometric import Overrides, read_thermal_photo
from mrgs.data.radiometric.table import MAX_BYTES
from mrgs.errors import SceneError

TABLE_C = np.array([[20.5, 21.25, -3.0], [19.0, 18.75, 22.0], [1.5, 2.0, 2.5]])


def read(tmp_path, text: str, encoding: str = "utf-8", overrides: Overrides | None = None):
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode(encoding))
    return read_thermal_photo(path, overrides)


def lines(separator: str, decimal: str = ".") -> str:
    return "".join(
        separator.join(str(v).replace(".", decimal) for v in row) + "\r\n"
        for row in TABLE_C.tolist()
    )


@pytest.mark.parametrize(
    "text",
    [
        lines(","),
        lines(";"),
        lines("\t"),
        lines(";", ","),
        lines("\t", ","),
        lines(", "),
        lines(";", ",").replace("\r\n", ";\r\n"),
        '"20,5","21,25","-3,0"\n"19,0","18,75","22,0"\n"1,5","2,0","2,5"\n',
        "File:;C:\\IR_0001.jpg\nEmissivity:;0,95\n\n" + lines(";", ","),
        "sep=;\nFrame 1;20,5;21,25;-3\nFrame 2;19;18,75;22\nFrame 3;1,5;2;2,5\nend\n",
        ",0,1,2\n0,20.5,21.25,-3.0\n1,19,18.75,22\n2,1.5,2,2.5\n",
        "0,1,2\n20.5,21.25,-3.0\n19,18.75,22\n1.5,2,2.5\n",
        ";0;1;2\n0;20,5;21,25;-3\n1;19;18,75;22\n2;1,5;2;2,5\n",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
def test_locales_and_headers(tmp_path, text, encoding):
    photo = read(tmp_path, text, encoding)
    np.testing.assert_allclose(photo.temperature_c, TABLE_C, atol=1e-5)
    assert photo.valid.all()


def test_whole_degrees_of_which_two_follow_each_other_are_no_count(tmp_path):
    photo = read(tmp_path, "20;21;23\n21;24;20\n25;19;18\n")
    assert photo.temperature_c.tolist() == [[20, 21, 23], [21, 24, 20], [25, 19, 18]]


def test_units(tmp_path):
    assert read(tmp_path, "Temperatur °F\n68;50;32\n14;50;77\n", "latin-1").temperature_c[
        0
    ].tolist() == [20, 10, 0]
    np.testing.assert_allclose(
        read(tmp_path, "293.15,283.15,273.15\n280,281,282\n").temperature_c[0],
        [20, 10, 0],
        atol=1e-4,
    )
    given = read(
        tmp_path, "273.15,283.15,573.15\n573,573,573\n", overrides=Overrides(unit="kelvin")
    )
    np.testing.assert_allclose(given.temperature_c[0], [0, 10, 300], atol=1e-4)


ROWS_F = "68;50;32\n14;50;77\n"
ROWS_HOT = "290;310;280\n285;281;300\n"


@pytest.mark.parametrize(
    ("text", "first_c"),
    [
        ("Unit,F\n" + ROWS_F, 20.0),
        ("Temperature (F)\n" + ROWS_F, 20.0),
        ("in deg F\n" + ROWS_F, 20.0),
        ("degF\n" + ROWS_F, 20.0),
        ("\u00baF\n" + ROWS_F, 20.0),
        (ROWS_F + "Unit: \u00b0F\n", 20.0),
        ("Units = Fahrenheit; room at 20 \u00b0C\nunit F\n" + ROWS_F, 20.0),
        ("Data in Deg F\n" + ROWS_F, 20.0),
        ("Temperature in F\n" + ROWS_F, 20.0),
        ("[F]\n" + ROWS_F, 20.0),
        ("Temp \u2109\n" + ROWS_F, 20.0),
        ("Emissivity,0.95,Temperature Unit,Fahrenheit\n" + ROWS_F, 20.0),
        ("2024-01-01 10:00:00;Units: degrees Fahrenheit\n" + ROWS_F, 20.0),
        ("Emissivity;0,95;Unit;deg F\n" + ROWS_F, 20.0),
        ("Emissivity,0.95,Unit,degF\n" + ROWS_F, 20.0),
        ("Emissivity,0.95,Unit,Kelvin\n" + ROWS_HOT, 16.85),
        ("Emissivity,0.95,Unit,Celsius\n" + ROWS_HOT, 290.0),
        ("Unit: 0.01 Kelvin\n29000;31000;28000\n28500;28100;30000\n", 16.85),
        ("Image 3: temperatures in \u00b0F\n" + ROWS_F, 20.0),
        ("Reflected: 20 \u00b0C\nTemperature;\u00b0F\n" + ROWS_F, 20.0),
        ("File: F:\\a.jpg, data: 2\n" + ROWS_F, 68.0),
        ("Temperature \u00b0C\n" + ROWS_HOT, 290.0),
        ("Temp. [\u00b0C]\n" + ROWS_HOT, 290.0),
        ("Unit: K\n" + ROWS_HOT, 16.85),
        ("Temperature in Kelvin\n" + ROWS_HOT, 16.85),
        ("(C) 2024 the maker, model K 200, f/1.4\n" + ROWS_HOT, 16.85),
    ],
)
def test_a_unit_that_is_named_is_that_of_the_numbers(tmp_path, text, first_c):
    photo = read(tmp_path, text)
    np.testing.assert_allclose(photo.temperature_c[0, 0], first_c, atol=1e-3)
    assert photo.temperature_c.shape == (2, 3)
    guessed = first_c == 16.85 and "the maker" in text
    assert bool(photo.facts.warnings) == guessed


@pytest.mark.parametrize(
    "setting",
    [
        "Reflected: 68 °F",
        "Température réfléchie;68,0 °F",
        "Reflected temperature [°F];68",
        "Reflected temperature;68;°F",
        "Reflected 68 °F",
        "Reflected temp.,68.0 F",
        "2024-01-01 10:00:00, Fahrenheit",
        "Reflected 68 deg F",
        "Reflected 68 Fahrenheit",
    ],
)
def test_a_unit_of_a_setting_is_not_that_of_the_numbers(tmp_path, setting):
    photo = read(tmp_path, f"{setting}\n20;21;22\n21;22;25\n")
    assert photo.temperature_c[0].tolist() == [20, 21, 22]
    assert "A setting is in °F" in photo.facts.warnings[0]
    stated = read(tmp_path, f"{setting}\nUnit: °F\n{ROWS_F}")
    assert stated.temperature_c[0, 0] == pytest.approx(20)
    assert stated.facts.warnings == ()


@pytest.mark.parametrize("gap", ["", "-", "--", "***", "#N/A", ">150"])
@pytest.mark.parametrize("column", [0, 1, 3])
@pytest.mark.parametrize("prefix", ["", "Row;"])
@pytest.mark.parametrize("suffix", ["", ";"])
def test_a_cell_without_a_number_is_a_pixel_without_temperature(
    tmp_path, gap, column, prefix, suffix
):
    rows = [[f"{20 + 2 * y}.{x}" for x in range(4)] for y in range(5)]
    rows[3][column] = gap
    text = "".join(f"{prefix}{';'.join(row)}{suffix}\n" for row in rows)
    photo = read(tmp_path, "Emissivity;0.95\n" + text)
    expected = np.ones((5, 4), bool)
    expected[3, column] = False
    assert photo.valid.tolist() == expected.tolist()
    assert photo.temperature_c[4].tolist() == pytest.approx([28.0, 28.1, 28.2, 28.3])


def test_missing_numbers_are_masked(tmp_path):
    photo = read(tmp_path, "20;nan;21\n-9999;20;1e999\n")
    assert photo.valid.tolist() == [[True, False, True], [False, True, False]]
    np.testing.assert_array_equal(np.isfinite(photo.temperature_c), photo.valid)


@pytest.mark.parametrize("text", ["no table here\n", "a,b,c\nd,e,f\n", "1;2\n", "\n\n"])
def test_no_table(tmp_path, text):
    with pytest.raises(SceneError, match="no table of"):
        read(tmp_path, text)


def test_a_text_that_is_too_long(tmp_path):
    with pytest.raises(SceneError, match="too long for"):
        read(tmp_path, "1" * (MAX_BYTES + 1))


@given(
    st.lists(st.lists(st.floats(-50, 90), min_size=4, max_size=4), min_size=2, max_size=6),
    st.sampled_from(";\t"),
)
def test_every_table_comes_back(tmp_path_factory, rows, separator):
    path = tmp_path_factory.mktemp("tables") / "a.csv"
    path.write_text(
        "\n".join(separator.join(f"{v:.3f}".replace(".", ",") for v in row) for row in rows)
    )
    photo = read_thermal_photo(path, Overrides(unit="celsius"))
    np.testing.assert_allclose(photo.temperature_c, rows, atol=6e-4)


def test_numbers_that_no_float32_holds_are_masked(tmp_path):
    photo = read(tmp_path, "20;1e300;inf\n20;21;22\n", overrides=Overrides(unit="celsius"))
    assert photo.valid.tolist() == [[True, False, False], [True, True, True]]
