"""What is known of the day on which the photos were taken, and cannot be read from them: object,
client, weather, conditions. Kept as ``survey.yaml`` in the run's folder."""

from __future__ import annotations

import datetime
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args, get_origin, get_type_hints

import yaml

from mrgs.errors import ConfigError, RunError
from mrgs.system.atomic import changing, write_text
from mrgs.system.disk import read_text
from mrgs.system.strict_yaml import convert, parse_yaml, read_yaml
from mrgs.system.wording import shown

SURVEY_FILE, CROP_UNDO_FILE = "survey.yaml", "crop.undo.json"
STEPS_KEPT = 50
LONGEST_TEXT = 2_000

Corners: TypeAlias = tuple[float, float, float, float, float, float]
Outlines: TypeAlias = tuple[tuple[tuple[float, float], ...], ...]
Crop: TypeAlias = tuple[Corners | None, Outlines | None]

Standard = Literal["EN 13187", "ISO 6781-3", "IEC TS 62446-3"]
Side = Literal["inside", "outside"]
Palette = Literal["inferno", "iron", "grey", "black-hot", "rainbow", "arctic", "lava"]


def _stated(label: str = "", unit: str = "", low: float = 0.0, high: float = 0.0) -> Any:
    """A field of the survey, which may be left out: its label in the report (empty where that does
    not list it), and for a number its unit, and the smallest and largest value."""
    return field(default=None, metadata={"label": label, "unit": unit, "limits": (low, high)})


@dataclass(frozen=True)
class Survey:
    """What the inspector states; None for what is not stated. Numbers are in the unit and between
    the limits that follow their label. ConfigError for a value that cannot be.

    Attributes:
        qualification: the inspector's, such as "ISO 9712 level 2".
        standard: that the conditions are compared with.
        construction: of the building, or the type of the modules.
        side: whether the building was photographed from inside or outside.
        time: of the photos, such as "06:30 to 07:10".
        precipitation: in the 12 hours before, and during the photos.
        sun: in the 12 hours before, and during the photos.
        hours_without_sun: since direct sun last fell on the surfaces.
        camera: thermal camera, where the photos do not name it.
        camera_accuracy_percent: as ``camera_accuracy_c``, a share of the reading in °C; the larger
            of the two counts. Without the K, 2 K are assumed.
        emissivity_uncertainty: standard uncertainty of the emissivities.
        air_uncertainty_c: standard uncertainty of the air inside and outside.
        hot_places: largest number of hottest places that the report lists.
        least_f_rsi: the report lists what is below it, such as the 0.7 of DIN 4108-2.
        photos_in_page: whether the exported page shows the photos of its views; it does by default.
        logo: picture for the report's cover; its path, from the survey's folder if it is relative.
        scale_low_c: with ``scale_high_c``, the ends of the palette in all pictures and on the page.
        crop: x, y, z of two opposite corners of the box to which the model is cropped.
        crop_outlines: of polygons, seen from above, to what is within all of which it is cropped.
    """

    title: str | None = _stated()
    object: str | None = _stated("Object")
    address: str | None = _stated("Address")
    client: str | None = _stated("Client")
    inspector: str | None = _stated("Inspector")
    company: str | None = _stated("Company")
    qualification: str | None = _stated("Qualification")
    purpose: str | None = _stated("Purpose")
    standard: Standard | None = _stated("Standard")  # noqa: RUF009 - a field
    construction: str | None = _stated("Construction")
    parts_observed: str | None = _stated("Parts observed")
    orientation: str | None = _stated("Orientation")
    side: Side | None = _stated("Photographed from")  # noqa: RUF009 - a field
    date: datetime.date | None = _stated("Date")  # noqa: RUF009 - a field
    time: str | None = _stated("Time")
    weather: str | None = _stated("Weather")
    precipitation: str | None = _stated("Precipitation")
    sun: str | None = _stated("Sun")
    inside_c: float | None = _stated("Air inside", "°C", -90, 90)
    outside_c: float | None = _stated("Air outside", "°C", -90, 90)
    outside_low_c: float | None = _stated("Lowest outside in the 24 hours before", "°C", -90, 90)
    outside_high_c: float | None = _stated("Highest outside in the 24 hours before", "°C", -90, 90)
    humidity_percent: float | None = _stated("Relative humidity inside", "%", 0, 100)
    pressure_pa: float | None = _stated("Pressure inside minus outside", "Pa", -1000, 1000)
    wind_m_s: float | None = _stated("Wind", "m/s", 0, 100)
    hours_without_sun: float | None = _stated("Without direct sun", "h", 0, 1000)
    irradiance_w_m2: float | None = _stated(
        "Irradiance in the plane of the modules", "W/m²", 0, 2000
    )
    cloud_eighths: float | None = _stated("Clouds", "/ 8", 0, 8)
    camera: str | None = _stated("Thermal camera")
    camera_serial: str | None = _stated("Serial number")
    camera_accuracy_c: float | None = _stated("Limit of error in the data sheet", "K", 0, 50)
    camera_accuracy_percent: float | None = _stated("Limit of error, of the reading", "%", 0, 50)
    emissivity_uncertainty: float | None = _stated(high=0.5)
    reflected_uncertainty_c: float | None = _stated(unit="K", high=500)
    distance_uncertainty_percent: float | None = _stated(unit="%", high=100)
    air_uncertainty_c: float | None = _stated(unit="K", high=50)
    hot_places: int | None = _stated(high=100)
    cold_places: int | None = _stated(high=100)
    least_f_rsi: float | None = _stated(high=1)
    logo: str | None = _stated()
    palette: Palette | None = _stated()  # noqa: RUF009 - a field
    scale_low_c: float | None = _stated(unit="°C", low=-273, high=5000)
    scale_high_c: float | None = _stated(unit="°C", low=-273, high=5000)
    photos_in_page: bool | None = _stated(high=1)
    crop: Corners | None = _stated()  # noqa: RUF009 - a field
    crop_outlines: Outlines | None = _stated()  # noqa: RUF009 - a field
    statement: str | None = _stated()
    remarks: str | None = _stated("Remarks")

    def __post_init__(self) -> None:
        for each in fields(self):
            name, value, unit = each.name, getattr(self, each.name), each.metadata["unit"]
            if isinstance(value, str) and (
                len(value) > LONGEST_TEXT or not value.replace("\n", " ").isprintable()
            ):
                raise ConfigError(
                    f"{name} must be a text of at most {LONGEST_TEXT:,} printable characters"
                )
            low, high = each.metadata["limits"]
            if isinstance(value, (int, float)) and not low <= value <= high:
                limits = f"{low:g} to {high:g} {unit}".rstrip()
                raise ConfigError(f"{name} must be from {limits}, not {shown(value)}")
        if self.crop is not None and any(self.crop[i] == self.crop[i + 3] for i in range(3)):
            raise ConfigError("crop must be two opposite corners, which differ in x, y and z")
        if (self.scale_low_c is None) != (self.scale_high_c is None):
            raise ConfigError("give both scale_low_c and scale_high_c, or neither")
        if self.scale is not None and not self.scale[0] < self.scale[1]:
            raise ConfigError("scale_high_c must be above scale_low_c")

    @property
    def scale(self) -> tuple[float, float] | None:
        """Temperatures of the palette's first and last colour, °C."""
        low, high = self.scale_low_c, self.scale_high_c
        return None if low is None or high is None else (low, high)

    @property
    def kept(self) -> Crop:
        """``crop`` and ``crop_outlines``."""
        return self.crop, self.crop_outlines

    def __bool__(self) -> bool:
        return any(value is not None for value in asdict(self).values())

    def stating(self, assignments: Sequence[str], source: str) -> Survey:
        """This survey with other values of some fields. ConfigError if an assignment lacks its =,
        names no field, or has a value that cannot be. ``assignments`` are ``NAME=VALUE`` each, the
        value as in YAML; an empty one takes it back."""
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


LABELS: dict[str, tuple[str, str]] = {
    each.name: (each.metadata["label"], each.metadata["unit"])
    for each in fields(Survey)
    if each.metadata["label"]
}
"""Label in the report and unit of each field that it lists."""


def read_survey(path: Path) -> Survey:
    """The survey in a file; an empty one where there is no file. ConfigError for a field that does
    not exist or a value that cannot be, RunError if the file cannot be read."""
    try:
        if not path.exists():
            return Survey()
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"{path} cannot be read ({error}): write it again") from None
    if parse_yaml(text, str(path)) is None:
        return Survey()
    return read_yaml(Survey, text, str(path))


def survey_of(folder: Path) -> Survey:
    """The survey of a run; where it has none, one to fill in is written into its folder. Errors as
    for ``read_survey``, also RunError if it cannot be written."""
    survey = read_survey(folder / SURVEY_FILE)
    if not (folder / SURVEY_FILE).exists():
        write_survey(folder / SURVEY_FILE, survey)
    return survey


def write_survey(path: Path, survey: Survey) -> Path:
    """Write a survey, its parts commented; returns the path. RunError if that fails."""
    lines = []
    stated = asdict(survey)
    template = files("mrgs").joinpath("survey/template.yaml").read_text(encoding="utf-8")
    for line in template.splitlines():
        name = line.removesuffix(":")
        if name in stated and stated[name] is not None:
            flow = None if isinstance(stated[name], tuple) else False  # numbers in one line
            line = yaml.safe_dump({name: stated[name]}, default_flow_style=flow, allow_unicode=True)
        lines.append(line.rstrip())
    return write_text(path, "\n".join(lines) + "\n")


def keep_crop(folder: Path, crop: Crop | None) -> None:
    """Write another crop into the survey of a run's folder; None undoes the last such change, of
    which 50 are kept. Errors as for ``read_survey``; RunError also if a file cannot be written,
    ConfigError if there is nothing to undo."""
    path = folder / CROP_UNDO_FILE
    with changing(folder / SURVEY_FILE):
        survey, states = read_survey(folder / SURVEY_FILE), []
        with suppress(OSError, ValueError, RecursionError, ConfigError):  # what is damaged is lost
            states = list(convert(tuple[Crop, ...], json.loads(read_text(path)), str(path)))
        if crop is not None:
            states = [*states, survey.kept][-STEPS_KEPT:]
        while states and states[-1] == (crop or survey.kept):
            states.pop()
        if crop is None and not states:
            raise ConfigError("there is nothing to undo: what is kept has not been changed")
        box, outlines = crop or states.pop()
        write_text(path, json.dumps(states) + "\n")
        write_survey(folder / SURVEY_FILE, replace(survey, crop=box, crop_outlines=outlines))
