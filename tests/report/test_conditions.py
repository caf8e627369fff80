from __future__ import annotations

import pytest

from mrgs.report.sections import conditions_of, stated_rows
from mrgs.report.texts import Texts
from mrgs.survey import Survey


def met(**stated) -> list[bool | None]:
    return [each.met for each in conditions_of(Survey(**stated))]


def test_a_building_needs_ten_kelvin_little_wind_and_no_sun():
    good = {
        "standard": "EN 13187", "inside_c": 21.0, "outside_c": 3.0, "outside_low_c": -2.0,
        "outside_high_c": 8.0, "wind_m_s": 3.0, "hours_without_sun": 9.0,
    }  # fmt: skip
    assert met(**good) == [True, True, True, True, None]
    assert met(**{**good, "outside_high_c": 12.0})[1] is False
    assert met(**{**good, "outside_high_c": 25.0})[1] is False
    assert met(**{**good, "inside_c": 12.0, "wind_m_s": 6.0})[::2] == [False, False, None]
    assert met(standard="EN 13187") == [None] * 5


@pytest.mark.parametrize(
    ("inside", "low", "high", "stated", "is_met"),
    [
        (21.0, -2.0, 8.0, "13.0 K", True),
        (21.0, -2.0, 11.0, "10.0 K", True),
        (18.0, 30.0, 40.0, "−12.0 K", True),
        (18.0, 20.0, 40.0, "−2.0 K", False),
        (21.0, 5.0, 40.0, "0.0 K", False),
    ],
)
def test_a_day_is_judged_by_its_least_difference(inside, low, high, stated, is_met):
    """0 where it was as warm outside as inside at some hour."""
    survey = Survey(standard="EN 13187", inside_c=inside, outside_low_c=low, outside_high_c=high)
    row = conditions_of(survey)[1]
    assert (row.stated, row.met) == (stated, is_met)


def test_a_cooled_building_may_be_colder_than_the_air_outside():
    (row, *_) = conditions_of(Survey(standard="EN 13187", inside_c=18.0, outside_c=33.0))
    assert (row.stated, row.met) == ("−15.0 K", True)


def test_what_is_just_enough_is_enough():
    plant = {"irradiance_w_m2": 600.0, "wind_m_s": 7.8, "cloud_eighths": 2.0}
    assert met(standard="IEC TS 62446-3", **plant) == [True, True, True, None]
    assert met(standard="EN 13187", hours_without_sun=2.0)[3] is True


def test_a_plant_needs_sun():
    plant = {"standard": "IEC TS 62446-3", "irradiance_w_m2": 700.0, "wind_m_s": 4.0}
    assert met(**plant, cloud_eighths=1.0) == [True, True, True, None]
    dull = {**plant, "irradiance_w_m2": 500.0, "cloud_eighths": 4.0}
    assert met(**dull) == [False, True, False, None]


@pytest.mark.parametrize(
    ("pixel_m", "stated", "met"),
    [
        (0.028, "2.8 cm", True),
        (0.05, "5.0 cm", False),
        (0.0304, "3.0 cm", True),
        (0.0003, "0.030 cm", True),
        (0.123, "12.3 cm", False),
    ],
)
def test_a_cell_of_a_module_is_five_pixels_wide(pixel_m, stated, met):
    row = conditions_of(Survey(standard="IEC TS 62446-3"), pixel_m)[-1]
    assert (row.stated, row.met) == (stated, met)


def test_without_a_standard_there_are_none():
    assert conditions_of(Survey(inside_c=21.0)) == []


@pytest.mark.parametrize(
    ("stated", "text"),
    [
        ({"irradiance_w_m2": 1050.0}, "1050 W/m²"),
        ({"hours_without_sun": 1000.0}, "1000 h"),
        ({"wind_m_s": 0.04}, "0.04 m/s"),
        ({"wind_m_s": 0.00001}, "0.00001 m/s"),
        ({"inside_c": 21.25}, "21.25 °C"),
        ({"inside_c": 21.0}, "21.0 °C"),
        ({"outside_c": -0.04}, "−0.04 °C"),
        ({"outside_c": -0.0}, "0.0 °C"),
        ({"humidity_percent": 45.0}, "45 %"),
        ({"camera_accuracy_percent": 0.25}, "0.25 %"),
        ({"camera_accuracy_c": 0.04}, "0.04 K"),
    ],
)
def test_what_is_stated_keeps_its_digits_at_least_those_of_its_unit_and_no_exponent(stated, text):
    ((_, shown),) = stated_rows(Survey(**stated), Texts())
    assert shown == text


def test_a_condition_is_judged_by_what_is_read():
    """16.4 - 6.4 is 9.999999999999998 in binary, and reads 10.0 K."""
    (row, *_) = conditions_of(Survey(standard="EN 13187", inside_c=16.4, outside_c=6.4))
    assert (row.stated, row.met) == ("10.0 K", True)


@pytest.mark.parametrize(
    ("standard", "wind", "stated", "met"),
    [
        ("EN 13187", 5.04, "5.04 m/s", False),
        ("EN 13187", 5.0, "5.0 m/s", True),
        ("IEC TS 62446-3", 7.8, "7.8 m/s", True),
    ],
)
def test_a_stated_value_is_judged_as_it_stands(standard, wind, stated, met):
    rows = {row.what: row for row in conditions_of(Survey(standard=standard, wind_m_s=wind))}
    assert (rows["Wind"].stated, rows["Wind"].met) == (stated, met)


def test_words_about_rain_are_no_number():
    words = "dry since 12.03.2026"
    row = conditions_of(Survey(standard="EN 13187", precipitation=words))[-1]
    assert (row.stated, row.words) == ("", words)


@pytest.mark.parametrize(("language", "row"), [("en", "21.5 °C"), ("de", "21,5 °C")])
def test_what_is_stated_is_shown_in_its_language(language, row):
    t = Texts(language)
    survey = Survey(client="Town", inside_c=21.5)
    assert stated_rows(survey, t, on_cover=True) == [(t("Client"), "Town")]
    assert stated_rows(survey, t) == [(t("Air inside"), row)]


def test_the_inspectors_words_are_not_translated_but_a_side_is():
    t = Texts("de")
    assert t("Clouds") != "Clouds"
    survey = Survey(client="Clouds", parts_observed="inside", side="inside")
    assert stated_rows(survey, t, on_cover=True) == [(t("Client"), "Clouds")]
    assert stated_rows(survey, t) == [
        (t("Parts observed"), "inside"),
        (t("Photographed from"), t("inside")),
    ]
    assert t("inside") != "inside"
