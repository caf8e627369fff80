"""Measured marks as texts for pages and tables, as CSV for spreadsheets, as GeoJSON for maps."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mrgs.data.earth import geodetic
from mrgs.marks.mark import Mark
from mrgs.marks.measure import MarkReading
from mrgs.marks.photo_readings import COVERAGE
from mrgs.pictures.escape import escape_cell
from mrgs.pictures.values import decimals_of, unit_label
from mrgs.scene import THERMAL, TemperatureRange, WorldFrame
from mrgs.system.atomic import write_text
from mrgs.system.wording import Message, number_text

HEADINGS = ("Mark", "Kind", "Mean", "±", "Min", "Max", "ΔT", "Size", "Photos", "Severity", "Note")
DASH = "–"

AssumedOf = Callable[[MarkReading], Sequence[str]]
"""What a reading takes for known, one sentence each."""


def size_text(reading: MarkReading, world: WorldFrame) -> str:
    """Length, area or diameter with its unit, in three digits; ± where the scale's is known."""
    unit, around = world.length_unit, _scale_uncertainty(world)
    if not math.isnan(reading.length):
        return Message(f"{{size}} {unit}", size=_with_around(reading.length, around))
    if not math.isnan(reading.area):
        return Message(f"{{size}} {unit}²", size=_with_around(reading.area, 2 * around))
    if reading.mark.kind == "spot":
        return Message(f"{{size}} {unit}", size=f"⌀ {digits(2 * reading.mark.radius)}")
    return DASH


def _scale_uncertainty(world: WorldFrame) -> float:
    """Relative uncertainty of lengths by the scene's scale, for 95 of 100 cases, half of that of
    areas; NaN where it is not known. It does not include how well a mark was placed."""
    return math.nan if world.scale_error is None else COVERAGE * world.scale_error


def value_text(
    value: float, temperature: TemperatureRange | None, *, sign: bool = False, unit: bool = False
) -> str:
    """A temperature (°C or normalised) or a difference with a proper minus sign, a dash for NaN;
    with a plus sign, and with its unit, where asked: that of a difference is the kelvin."""
    if math.isnan(value):
        return DASH
    text = number_text(value, decimals_of(THERMAL, temperature), sign=sign)
    label = unit_label(THERMAL, temperature)
    if unit and label:
        return f"{text} {'K' if sign else label}"
    return text


def around_text(around: float, temperature: TemperatureRange | None, *, unit: bool = False) -> str:
    """What follows a ±: no less than the last digit, since ± 0.0 would promise the exact truth."""
    last_digit = 10.0 ** -decimals_of(THERMAL, temperature)
    least = around if math.isnan(around) else max(around, last_digit)
    return value_text(least, temperature, unit=unit)


def total_uncertainty(reading: MarkReading) -> float:
    """Total uncertainty of the mean; NaN where it is not known."""
    return math.nan if reading.uncertainty is None else reading.uncertainty.total


def uncertainty_parts(reading: MarkReading) -> dict[str, float]:
    """The parts of the uncertainty under all names of ``PART_NAMES``; NaN where not known."""
    known = {} if reading.uncertainty is None else reading.uncertainty.known
    return {name: known.get(name, math.nan) for name in PART_NAMES}


def settings_texts(reading: MarkReading) -> list[str]:
    """Emissivity and reflected temperature that a mark is corrected for; empty as for photos."""
    emissivity, reflected = _settings_of(reading)
    texts = [] if emissivity is None else [f"ε {emissivity:.3g}"]
    if reflected is not None:
        texts.append(f"T_refl {number_text(reflected, 1)} °C")
    return texts


def corrected_text(reading: MarkReading) -> str:
    """What a mark is corrected for, in words; empty where it is as the photos have it."""
    settings = ", ".join(settings_texts(reading))
    return f"corrected for {settings}" if settings and not reading.problem else ""


def _settings_of(reading: MarkReading) -> tuple[float | None, float | None]:
    """Emissivity and reflected temperature of the surface; the mark's own if it has a problem."""
    if reading.problem:
        return reading.mark.emissivity, reading.mark.reflected_c
    surface = reading.surface
    return (None, None) if surface is None else (surface.emissivity, surface.reflected_c)


def text_rows(
    readings: Sequence[MarkReading], temperature: TemperatureRange | None, world: WorldFrame
) -> list[tuple[str, ...]]:
    """A row of texts for each reading, under ``HEADINGS``."""

    def row(reading: MarkReading) -> tuple[str, ...]:
        mark, note = reading.mark, " ".join(reading.mark.note.split())
        said = (reading.problem, corrected_text(reading), *reading.remarks, note)
        low, high = (value_text(each, temperature) for each in (reading.low, reading.high))
        return (
            mark.name,
            mark.kind,
            value_text(reading.mean, temperature),
            around_text(total_uncertainty(reading), temperature),
            low,
            high,
            value_text(reading.difference, temperature, sign=True),
            size_text(reading, world),
            DASH if reading.photos is None else str(reading.photos),
            mark.severity or DASH,
            "; ".join(filter(None, said)),
        )

    return [row(each) for each in readings]


def texts_of_reading(
    reading: MarkReading, reference: str, temperature: TemperatureRange | None, world: WorldFrame
) -> dict[str, Any]:
    """A reading as a page shows it; numbers are formatted. ``around`` is empty if not known, a part
    of the uncertainty a dash; ``settings`` are empty if they are the photos'. ``reference`` is the
    mark that all differences refer to, empty for none."""
    mark = reading.mark
    difference = value_text(reading.difference, temperature, sign=True)
    around, of_difference = (
        "" if math.isnan(each) else around_text(each, temperature)
        for each in (total_uncertainty(reading), reading.difference_uncertainty)
    )
    return {
        "name": mark.name,
        "severity": mark.severity,
        "mean": value_text(reading.mean, temperature),
        "around": around,
        "parts": {
            PART_NAMES[name]: value_text(part, temperature)
            for name, part in uncertainty_parts(reading).items()
        },
        "low": value_text(reading.low, temperature),
        "high": value_text(reading.high, temperature),
        "difference": " ± ".join(filter(None, (difference, of_difference))),
        "compared_with": "" if math.isnan(reading.difference) else mark.against or reference,
        "size": size_text(reading, world),
        "photos": DASH if reading.photos is None else str(reading.photos),
        "settings": settings_texts(reading),
        "note": mark.note,
        "problem": reading.problem,
        "remarks": reading.remarks,
    }


def facts_of_reading(
    reading: MarkReading,
    temperature: TemperatureRange | None,
    world: WorldFrame,
    assumed: Sequence[str] = (),
) -> dict[str, Any]:
    """A reading under the names of the columns of the CSV file; None where there is no value.
    ``assumed`` is what the reading takes for known, one sentence each."""
    mark = reading.mark
    value_unit = "c" if temperature is not None else "normalised"
    length_unit = "m" if world.metric else "units"
    around = _scale_uncertainty(world)
    x, y, z = np.mean(mark.points, axis=0).tolist()
    emissivity, reflected = _settings_of(reading)
    numbers = {
        f"mean_{value_unit}": reading.mean,
        f"min_{value_unit}": reading.low,
        f"max_{value_unit}": reading.high,
        f"std_{value_unit}": reading.spread,
        f"uncertainty_{value_unit}": total_uncertainty(reading),
        **{f"uncertainty_{n}_{value_unit}": p for n, p in uncertainty_parts(reading).items()},
        f"difference_{value_unit}": reading.difference,
        f"difference_uncertainty_{value_unit}": reading.difference_uncertainty,
        f"length_{length_unit}": reading.length,
        f"length_scale_uncertainty_{length_unit}": around * reading.length,
        f"area_{length_unit}2": reading.area,
        f"area_scale_uncertainty_{length_unit}2": 2 * around * reading.area,
        f"diameter_{length_unit}": 2 * mark.radius if mark.kind == "spot" else np.nan,
        "covered": reading.covered,
    }
    return {
        "name": mark.name,
        "kind": mark.kind,
        "severity": mark.severity,
        **{name: _known(value) for name, value in numbers.items()},
        "photos": reading.photos,
        "emissivity": emissivity,
        "reflected_c": reflected,
        "x": x,
        "y": y,
        "z": z,
        "against": mark.against,
        "note": mark.note,
        "problem": reading.problem,
        "remarks": " ".join(map(str, (*reading.remarks, *assumed))),
    }


def write_csv(
    path: Path,
    readings: Sequence[MarkReading],
    temperature: TemperatureRange | None,
    world: WorldFrame,
    assumed: AssumedOf = lambda reading: (),
) -> list[Path]:
    """Write a row for each mark, and beside it ``NAME_profiles.csv`` with a row for each sample of
    the lines; returns the paths. RunError if a file cannot be written. ``assumed`` returns what a
    reading takes for known."""
    rows = [facts_of_reading(each, temperature, world, assumed(each)) for each in readings]
    names = list(facts_of_reading(_NOTHING, temperature, world))
    paths = [write_rows(path, names, rows)]
    profiles = [
        {"name": reading.mark.name, "distance": at, "value": value, "uncertainty": around}
        for reading in readings
        for at, value, around in _samples(reading)
    ]
    if profiles:
        beside = path.with_name(f"{path.stem}_profiles{path.suffix}")
        paths.append(write_rows(beside, list(profiles[0]), profiles))
    return paths


def write_geojson(
    path: Path,
    readings: Sequence[MarkReading],
    temperature: TemperatureRange | None,
    world: WorldFrame,
    assumed: AssumedOf = lambda reading: (),
) -> Path:
    """Write the marks as points, lines and polygons with their readings; returns the path.

    In a georeferenced scene coordinates are longitude, latitude and height (WGS 84), as GeoJSON has
    them; elsewhere the scene's own x, y, z, which the file states. Arguments and errors are those
    of ``write_csv``.
    """
    facts = (facts_of_reading(each, temperature, world, assumed(each)) for each in readings)
    marks = (reading.mark for reading in readings)
    return write_features(path, zip(facts, marks, strict=True), world)


def write_features(
    path: Path, found: Iterable[tuple[Mapping[str, Any], Mark]], world: WorldFrame
) -> Path:
    """Write GeoJSON of facts and the mark that each is of, see ``write_geojson``; returns the path.
    RunError if the file cannot be written."""
    on_earth = world.is_georeferenced
    features = [
        {"type": "Feature", "properties": facts, "geometry": _geometry(mark, world)}
        for facts, mark in found
    ]
    collection: dict[str, Any] = {"type": "FeatureCollection", "features": features}
    if not on_earth:
        frame = "the scene" if world.offset is None else "the survey's local frame"
        collection["coordinates"] = f"x, y, z of {frame}, {world.length_unit}; not on Earth"
    text = json.dumps(collection, indent=1, ensure_ascii=False, allow_nan=False)
    return write_text(path, text + "\n")


def _geometry(mark: Mark, world: WorldFrame) -> dict[str, Any]:
    """A mark in longitude, latitude and height, or else in the survey's or the scene's frame."""
    places = [list(point) for point in mark.points]
    if world.offset is not None:
        places = [np.add(point, world.offset).tolist() for point in mark.points]
    elif world.is_georeferenced and world.origin is not None:
        found = [geodetic(np.array(point), world.origin) for point in mark.points]
        places = [
            [round(e.longitude_deg, 9), round(e.latitude_deg, 9), e.altitude_m or 0.0]
            for e in found
        ]
    if mark.kind == "spot":
        return {"type": "Point", "coordinates": places[0]}
    if mark.kind == "line":
        return {"type": "LineString", "coordinates": places}
    return {"type": "Polygon", "coordinates": [[*places, places[0]]]}


def write_rows(path: Path, names: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> Path:
    """Write rows under the names of their columns as CSV; returns the path. RunError if the file
    cannot be written."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
    return write_text(path, buffer.getvalue())


def _cell(value: Any) -> Any:
    """A cell; a text that a spreadsheet would run as a formula is quoted."""
    if isinstance(value, float):
        return f"{value:.6g}"
    return escape_cell(value) if isinstance(value, str) else value


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _with_around(size: float, share: float) -> str:
    """A size, ± its uncertainty where the share that this is of it is known."""
    return digits(size) if math.isnan(share) else f"{digits(size)} ± {digits(share * size, 1)}"


def digits(value: float, count: int = 3) -> str:
    """A number with a count of significant digits, without an exponent."""
    decimals = 2 if value <= 0 else max(0, count - 1 - math.floor(math.log10(value)))
    return f"{value:.{decimals}f}"


def pixel_cm_text(pixel_m: float) -> str:
    """The width of a pixel in cm: with a decimal, below 1 cm with two digits."""
    cm = 100 * pixel_m
    return digits(cm, 2) if cm < 1 else f"{cm:.1f}"


_NOTHING = MarkReading(Mark("-", "spot", ((0.0, 0.0, 0.0),), (0.0, 0.0, 1.0), radius=1.0))

PART_NAMES = {
    "photos": "photos",
    "model": "model",
    "detail": "fine detail",
    "camera": "data sheet",
    "evenness": "unevenness of the camera",
    "emissivity": "emissivity",
    "reflected": "reflected temperature",
    "distance": "distance",
    "air": "air temperature",
}
"""What the parts of an uncertainty are called."""

MOSTLY_COVERED = 0.98
"""Covered share of a mark below which its text mentions the share."""


def label_text(reading: MarkReading, temperature: TemperatureRange | None) -> str:
    """Label of a mark in a picture: its name, and its mean if there is one."""
    return f"{reading.mark.name}  {value_with_uncertainty(reading, temperature)}".rstrip()


def value_with_uncertainty(reading: MarkReading, temperature: TemperatureRange | None) -> str:
    """The mean, ± its uncertainty where that is known; empty without a temperature."""
    if reading.problem:
        return ""
    around = total_uncertainty(reading)
    if math.isnan(around):
        return value_text(reading.mean, temperature, unit=True)
    mean = value_text(reading.mean, temperature)
    return f"{mean} ± {around_text(around, temperature, unit=True)}"


def mark_text(
    reading: MarkReading, reference: str, temperature: TemperatureRange | None, world: WorldFrame
) -> dict[str, Any]:
    """A mark as a panel lists it: what it is, what was measured, and what can be changed.
    ``reference`` is the name of the mark that all differences refer to; empty for none."""
    mark = reading.mark
    return {
        "name": mark.name,
        "kind": mark.kind,
        "value": value_with_uncertainty(reading, temperature)
        or value_text(reading.mean, temperature),
        "difference": difference_text(reading, temperature),
        "problem": reading.problem,
        "lines": _lines(reading, temperature, world),
        "profile": [(at, value) for at, value, _ in _samples(reading)],
        "ends": _ends(reading, temperature, world),
        "note": mark.note,
        "severity": mark.severity,
        "area": mark.is_area,
        "emissivity": mark.emissivity,
        "reflected_c": mark.reflected_c,
        "reference": mark.name == reference,
    }


def difference_text(reading: MarkReading, temperature: TemperatureRange | None) -> str:
    """ΔT, ± its uncertainty where that is known; empty without one."""
    if math.isnan(reading.difference):
        return ""
    around = reading.difference_uncertainty
    text = f"ΔT {value_text(reading.difference, temperature, sign=True, unit=math.isnan(around))}"
    if math.isnan(around):
        return text
    unit = "" if temperature is None else " K"
    return f"{text} ± {around_text(around, temperature)}{unit}"


def _lines(
    reading: MarkReading, temperature: TemperatureRange | None, world: WorldFrame
) -> list[str]:
    """Extremes, remarks, size and photos of a mark."""
    lines = []
    if not math.isnan(reading.low):
        low = value_text(reading.low, temperature)
        high = value_text(reading.high, temperature, unit=True)
        lines.append(f"{low} to {high}")
    if reading.uncertainty is not None and (known := reading.uncertainty.known):
        parts = ", ".join(f"{PART_NAMES[n]} {value_text(p, temperature)}" for n, p in known.items())
        without = "" if "camera" in known else ", without the camera's own error"
        lines.append(f"± for 95 of 100 cases{without}: {parts}")
    if not reading.mark.has_settings and (corrected := corrected_text(reading)):
        lines.append(corrected)
    lines.extend(reading.remarks)
    if (size := size_text(reading, world)) != DASH:
        lines.append(size)
    if reading.covered < MOSTLY_COVERED and not reading.problem:
        lines.append(f"{100 * reading.covered:.0f} % of it shows a surface")
    if reading.photos is not None:
        lines.append(f"seen by {reading.photos} thermal photos")
    return lines


def _samples(reading: MarkReading) -> list[tuple[float, float | None, float | None]]:
    """Distance, value and ± of a line's samples; None where not known."""
    if (profile := reading.profile) is None:
        return []
    columns = profile.distances, profile.values, profile.uncertainties
    samples = zip(*(each.tolist() for each in columns), strict=True)
    return [(at, _known(value), _known(around)) for at, value, around in samples]


def _ends(
    reading: MarkReading, temperature: TemperatureRange | None, world: WorldFrame
) -> list[str]:
    """The lowest and the highest value of a line's profile and its length, with their units; empty
    without a value."""
    if reading.profile is None or not np.isfinite(reading.profile.values).any():
        return []
    values = np.nanmin(reading.profile.values), np.nanmax(reading.profile.values)
    texts = [value_text(float(value), temperature, unit=True) for value in values]
    return [*texts, str(size_text(reading, world))]
