"""What the report says of the survey and of the settings that temperatures were computed with."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from datetime import date
from decimal import Decimal
from typing import NamedTuple

from mrgs.marks.tables import digits
from mrgs.pictures.settings import Setting
from mrgs.report.texts import Texts
from mrgs.survey import Survey

LEAST_DIFFERENCE_K = 10.0
MOST_PIXEL_CM = 3.0
"""So that a cell of a module is five pixels wide."""

ONE_DECIMAL = ("°C", "K", "m/s")
"""Units whose values always have a decimal."""


class Condition(NamedTuple):
    """One condition of a standard; texts are English, for ``Texts``. ``stated`` is empty if neither
    survey nor photos have the quantity, ``met`` None if that is to be judged, and ``words`` are the
    inspector's own in place of ``stated``, printed as they are."""

    what: str
    asked: str
    stated: str
    met: bool | None
    words: str = ""


def conditions_of(survey: Survey, pixel_m: float | None = None) -> list[Condition]:
    """The conditions of the survey's standard, as practitioners cite it; none without one.

    Args:
        pixel_m: width of a pixel of the thermal photos on the surfaces; None if not known.
    """
    if survey.standard is None:
        return []
    if survey.standard == "IEC TS 62446-3":
        pixel = "" if pixel_m is None else f"{pixel_cm_text(pixel_m)} cm"
        met = None if pixel_m is None else _rounded(100 * pixel_m) <= MOST_PIXEL_CM
        return [
            *(_compared(survey, *each) for each in _PLANT),
            Condition("Pixel of the thermal photos", "at most 3 cm", pixel, met),
        ]
    found = None
    if survey.inside_c is not None and survey.outside_c is not None:
        found = _rounded(survey.inside_c - survey.outside_c)
    met = None if found is None else abs(found) >= LEAST_DIFFERENCE_K
    return [
        Condition("Air inside minus outside", "at least 10 K", _derived(found, "K"), met),
        _steady(survey),
        *(_compared(survey, *each) for each in _BUILDING),
        Condition("Precipitation", "dry surfaces", "", None, survey.precipitation or ""),
    ]


_BUILDING = (
    ("Wind", "wind_m_s", "m/s", "at most 5 m/s", -math.inf, 5.0),
    ("Without direct sun", "hours_without_sun", "h", "at least 2 h", 2.0, math.inf),
)
_PLANT = (
    ("Irradiance in the plane of the modules", "irradiance_w_m2", "W/m²", "at least 600 W/m²",
     600.0, math.inf),
    ("Wind", "wind_m_s", "m/s", "at most 7.8 m/s (4 Beaufort)", -math.inf, 7.8),
    ("Clouds", "cloud_eighths", "/ 8", "at most 2 eighths of the sky", -math.inf, 2.0),
)  # fmt: skip
"""Arguments of ``_compared``."""


def _compared(
    survey: Survey, what: str, field: str, unit: str, asked: str, low: float, high: float
) -> Condition:
    """A field of the survey that must be within limits."""
    found = getattr(survey, field)
    return Condition(
        what, asked, _given(found, unit), None if found is None else low <= found <= high
    )


def _steady(survey: Survey) -> Condition:
    """The difference over the 24 hours before, from the warmest and the coldest hour outside."""
    known = (survey.inside_c, survey.outside_low_c, survey.outside_high_c)
    stated, met = "", None
    if None not in known:
        inside, low, high = (float(each) for each in known if each is not None)
        warmer, colder = inside - low, inside - high
        least = min(warmer, colder, key=abs) if warmer * colder > 0 else 0.0
        stated, met = _derived(least, "K"), abs(_rounded(least)) >= LEAST_DIFFERENCE_K
    return Condition("The same, over the 24 hours before", "at least 10 K", stated, met)


def pixel_cm_text(pixel_m: float) -> str:
    """The width of a pixel in cm: with a decimal, below 1 cm with two digits."""
    cm = 100 * pixel_m
    return digits(cm, 2) if cm < 1 else f"{cm:.1f}"


def _derived(value: float | None, unit: str) -> str:
    """A computed value with its unit, rounded as it is judged."""
    return "" if value is None else _given(_rounded(value), unit)


def _given(value: float | None, unit: str) -> str:
    """A value that was stated, with its unit and all its digits: at least one decimal, but for
    units that are mostly stated whole."""
    if value is None:
        return ""
    text = f"{Decimal(repr(float(value) + 0.0)):f}"  # repr alone may have an exponent
    if unit not in ONE_DECIMAL:
        text = text.removesuffix(".0")
    return f"{text} {unit}".replace("-", "−")


def _rounded(value: float) -> float:
    """As it is shown, so that what is judged is what is read; without a minus before 0."""
    return round(value, 1) + 0.0


def stated_rows(survey: Survey, t: Texts) -> list[tuple[str, str]]:
    """Label and value of what the survey states, translated."""
    rows = []
    for name, (label, unit) in LABELS.items():
        value = getattr(survey, name)
        if value is None:
            continue
        if isinstance(value, float):
            text = t.number(_given(value, unit))
        elif isinstance(value, date):
            text = t.date(value)
        else:
            text = t(str(value)) if name == "side" else str(value)
        rows.append((t(label), text))
    return rows


LABELS: Mapping[str, tuple[str, str]] = {
    "object": ("Object", ""),
    "address": ("Address", ""),
    "client": ("Client", ""),
    "inspector": ("Inspector", ""),
    "company": ("Company", ""),
    "qualification": ("Qualification", ""),
    "purpose": ("Purpose", ""),
    "standard": ("Standard", ""),
    "construction": ("Construction", ""),
    "parts_observed": ("Parts observed", ""),
    "orientation": ("Orientation", ""),
    "side": ("Photographed from", ""),
    "date": ("Date", ""),
    "time": ("Time", ""),
    "weather": ("Weather", ""),
    "precipitation": ("Precipitation", ""),
    "sun": ("Sun", ""),
    "inside_c": ("Air inside", "°C"),
    "outside_c": ("Air outside", "°C"),
    "outside_low_c": ("Lowest outside in the 24 hours before", "°C"),
    "outside_high_c": ("Highest outside in the 24 hours before", "°C"),
    "humidity_percent": ("Relative humidity inside", "%"),
    "pressure_pa": ("Pressure inside minus outside", "Pa"),
    "wind_m_s": ("Wind", "m/s"),
    "hours_without_sun": ("Without direct sun", "h"),
    "irradiance_w_m2": ("Irradiance in the plane of the modules", "W/m²"),
    "cloud_eighths": ("Clouds", "/ 8"),
    "camera": ("Thermal camera", ""),
    "camera_serial": ("Serial number", ""),
    "camera_accuracy_c": ("Limit of error in the data sheet", "K"),
    "camera_accuracy_percent": ("Limit of error, of the reading", "%"),
    "remarks": ("Remarks", ""),
}
"""Label in the report and unit of each field."""


def emissivity_sentence(settings: Mapping[str, Setting], t: Texts) -> str:
    """Which emissivity the temperatures are for. They are apparent ones only where it is 1."""
    emissivity, reflected = settings["emissivity"], settings["reflected_c"]
    if emissivity.value == reflected.value == "":
        return t(
            "Emissivity: the scene's files do not record the emissivity and the reflected "
            "temperature that the temperatures were computed with; look them up in the camera or "
            "its original photos. Only surfaces with an emissivity of their own are corrected."
        )
    if emissivity.low == "1.00":
        return t(
            "Emissivity: the temperatures are apparent ones (emissivity {emissivity}); only "
            "surfaces with an emissivity of their own are corrected.",
            emissivity=_value(emissivity, t),
        )
    return t(
        "Emissivity: the temperatures were computed with emissivity {emissivity} and reflected "
        "temperature {reflected}; only surfaces with an emissivity of their own are corrected.",
        emissivity=_value(emissivity, t),
        reflected=_value(reflected, t),
    )


def air_sentence(settings: Mapping[str, Setting], t: Texts) -> str:
    """What was corrected for the air."""
    distance, air, humidity = (
        settings[name] for name in ("distance_m", "atmospheric_c", "humidity")
    )
    if distance.value == air.value == humidity.value == "":
        return t("Air: humidity, distance and wind are not corrected beyond what the camera did.")
    return t(
        "Air: the temperatures were computed with distance {distance}, air temperature {air} and "
        "relative humidity {humidity}. Wind is not corrected.",
        distance=_value(distance, t),
        air=_value(air, t),
        humidity=_value(humidity, t),
    )


def known_row(settings: Mapping[str, Setting], t: Texts) -> tuple[str, str]:
    """A row of the settings that are known."""
    known = _listed((each for each in settings.values() if each.value), t)
    return t("Settings of the temperatures"), known or t("not in the scene's files")


def given_rows(settings: Mapping[str, Setting], t: Texts) -> list[tuple[str, str]]:
    """A row of the settings that are the user's; none without any."""
    given = _listed((each for each in settings.values() if each.given), t)
    return [(t("Of these, given by the user"), given)] if given else []


def _listed(settings: Iterable[Setting], t: Texts) -> str:
    return "; ".join(f"{t(each.label)} {_range(each, t)}" for each in settings)


def _value(setting: Setting, t: Texts) -> str:
    """A setting and where it is from, for a sentence."""
    if not setting.value:
        unknown = t("not in the scene's files")
        return f"({unknown})"
    text = _range(setting, t)
    return t("{value} (given by the user)", value=text) if setting.given else text


def _range(setting: Setting, t: Texts) -> str:
    low, high = t.number(setting.low), t.number(setting.high)
    text = t("{low} to {high}", low=low, high=high) if setting.differs else low
    return text + setting.unit
