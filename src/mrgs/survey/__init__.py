"""What is known of the day on which the photos were taken, and cannot be read from them: object,
client, weather, conditions. Kept as ``survey.yaml`` in the run's folder."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import yaml

from mrgs.errors import ConfigError, RunError
from mrgs.system.atomic import write_text
from mrgs.system.strict_yaml import convert, parse_yaml, read_yaml
from mrgs.system.wording import shown

SURVEY_FILE = "survey.yaml"
LONGEST_TEXT = 2_000
LARGEST_FILE = 100_000
"""Bytes."""

Standard = Literal["EN 13187", "ISO 6781-3", "IEC TS 62446-3"]
Side = Literal["inside", "outside"]


@dataclass(frozen=True)
class Survey:
    """What the inspector states; None for what is not stated.

    Attributes:
        object: what was inspected.
        client: who ordered the inspection.
        company: the inspector's.
        qualification: the inspector's, such as "ISO 9712 level 2".
        purpose: the question to answer.
        standard: that the conditions are compared with.
        construction: of the building, or the type of the modules.
        parts_observed: of the object.
        orientation: that the inspected side faces.
        side: whether the building was photographed from inside or outside.
        time: of the photos, such as "06:30 to 07:10".
        precipitation: in the 12 hours before, and during the photos.
        sun: in the 12 hours before, and during the photos.
        inside_c: temperature of the air inside, °C.
        outside_c: temperature of the air outside, °C.
        outside_low_c: lowest temperature outside in the 24 hours before, °C.
        outside_high_c: highest temperature outside in the 24 hours before, °C.
        humidity_percent: relative humidity of the air inside.
        pressure_pa: pressure inside minus outside, Pa.
        hours_without_sun: since direct sun last fell on the surfaces.
        irradiance_w_m2: of the sun in the plane of the modules, W/m².
        camera: thermal camera, where the photos do not name it.
        camera_serial: its serial number, where the photos do not have it.
        camera_accuracy_c: limit of error in the camera's data sheet, K.
        camera_accuracy_percent: the same as a share of the reading in °C, per cent; the larger of
            the two counts. Without the K, 2 K are assumed.
        emissivity_uncertainty: standard uncertainty of the emissivities.
        reflected_uncertainty_c: standard uncertainty of the reflected temperatures, K.
        distance_uncertainty_percent: standard uncertainty of the distances, per cent.
        hot_places: largest number of hottest places that are proposed as anomalies.
        statement: the inspector's conclusion.

    Raises:
        ConfigError: a value that cannot be.
    """

    title: str | None = None
    object: str | None = None
    address: str | None = None
    client: str | None = None
    inspector: str | None = None
    company: str | None = None
    qualification: str | None = None
    purpose: str | None = None
    standard: Standard | None = None
    construction: str | None = None
    parts_observed: str | None = None
    orientation: str | None = None
    side: Side | None = None
    date: datetime.date | None = None
    time: str | None = None
    weather: str | None = None
    precipitation: str | None = None
    sun: str | None = None
    inside_c: float | None = None
    outside_c: float | None = None
    outside_low_c: float | None = None
    outside_high_c: float | None = None
    humidity_percent: float | None = None
    pressure_pa: float | None = None
    wind_m_s: float | None = None
    hours_without_sun: float | None = None
    irradiance_w_m2: float | None = None
    cloud_eighths: float | None = None
    camera: str | None = None
    camera_serial: str | None = None
    camera_accuracy_c: float | None = None
    camera_accuracy_percent: float | None = None
    emissivity_uncertainty: float | None = None
    reflected_uncertainty_c: float | None = None
    distance_uncertainty_percent: float | None = None
    hot_places: int | None = None
    cold_places: int | None = None
    statement: str | None = None
    remarks: str | None = None

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if isinstance(value, str) and (
                len(value) > LONGEST_TEXT or not value.replace("\n", " ").isprintable()
            ):
                raise ConfigError(
                    f"{name} must be a text of at most {LONGEST_TEXT:,} printable characters"
                )
            low, high, unit = LIMITS.get(name, (0.0, 0.0, ""))
            if isinstance(value, (int, float)) and not low <= value <= high:
                raise ConfigError(f"{name} must be from {low:g} to {high:g}{unit}, not {value:g}")

    def __bool__(self) -> bool:
        return any(value is not None for value in asdict(self).values())

    def stating(self, assignments: Sequence[str], source: str) -> Survey:
        """This survey with other values of some fields.

        Args:
            assignments: ``NAME=VALUE`` each, the value as in YAML; an empty one takes it back.
            source: of the assignments, for messages.

        Raises:
            ConfigError: no assignment, no such field, or a value that cannot be.
        """
        hints = get_type_hints(Survey)
        stated: dict[str, Any] = {}
        for text in assignments:
            name, equals, value = text.partition("=")
            if not equals or name not in hints:
                raise ConfigError(
                    f"{source} {shown(text)}: write NAME=VALUE, with a NAME of {', '.join(hints)}"
                )
            if value.strip():
                kind = next(each for each in get_args(hints[name]) if each is not type(None))
                is_text = kind is str or get_origin(kind) is Literal  # as it is; others as in YAML
                parsed = value if is_text else parse_yaml(value, f"{source}: {name}")
                stated[name] = convert(hints[name], parsed, f"{source}: {name}")
            else:
                stated[name] = None
        try:
            return replace(self, **stated)
        except ConfigError as error:
            raise ConfigError(f"{source}: {error}") from error


LIMITS: dict[str, tuple[float, float, str]] = {
    **dict.fromkeys(
        ("inside_c", "outside_c", "outside_low_c", "outside_high_c"), (-90.0, 90.0, " °C")
    ),
    "humidity_percent": (0.0, 100.0, " %"),
    "pressure_pa": (-1000.0, 1000.0, " Pa"),
    "wind_m_s": (0.0, 100.0, " m/s"),
    "hours_without_sun": (0.0, 1000.0, " h"),
    "irradiance_w_m2": (0.0, 2000.0, " W/m²"),
    "cloud_eighths": (0.0, 8.0, ""),
    "camera_accuracy_c": (0.0, 50.0, " K"),
    "camera_accuracy_percent": (0.0, 50.0, " %"),
    "emissivity_uncertainty": (0.0, 0.5, ""),
    "reflected_uncertainty_c": (0.0, 500.0, " K"),
    "distance_uncertainty_percent": (0.0, 100.0, " %"),
    "hot_places": (0, 100, ""),
    "cold_places": (0, 100, ""),
}
"""Smallest and largest value of each number, and its unit as written behind one."""


def read_survey(path: Path) -> Survey:
    """The survey in a file; an empty one where there is no file.

    Raises:
        ConfigError: a field that does not exist, or a value that cannot be.
        RunError: the file cannot be read.
    """
    try:
        if not path.exists():
            return Survey()
        if path.stat().st_size > LARGEST_FILE:
            raise RunError(f"{path} has more than {LARGEST_FILE:,} bytes: it is no survey")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"{path} cannot be read ({error}): write it again") from None
    if parse_yaml(text, str(path)) is None:
        return Survey()
    return read_yaml(Survey, text, str(path))


def write_survey(path: Path, survey: Survey) -> Path:
    """Write a survey with a comment for each part; returns the path. RunError if the file cannot be
    written."""
    lines = []
    stated = asdict(survey)
    template = files("mrgs").joinpath("survey/template.yaml").read_text(encoding="utf-8")
    for line in template.splitlines():
        name = line.removesuffix(":")
        if name in stated and stated[name] is not None:
            line = yaml.safe_dump({name: stated[name]}, allow_unicode=True).rstrip()
        lines.append(line)
    return write_text(path, "\n".join(lines) + "\n")
