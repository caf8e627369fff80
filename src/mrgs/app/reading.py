"""``mrgs read``: what one thermal photo says."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mrgs.app.commands import Read
from mrgs.app.terminal import print_note, say
from mrgs.data.radiometric import ThermalPhoto, read_thermal_photo
from mrgs.errors import ConfigError
from mrgs.pictures.files import write_float_tiff
from mrgs.system.atomic import write_text
from mrgs.system.wording import number_text


def read(command: Read) -> None:
    """Print what a photo says, and write its temperatures. Errors of ``read_thermal_photo``;
    ConfigError for an output that cannot be written, or a photo without temperatures."""
    output = command.output
    if output is not None and output.suffix.lower() not in (".csv", ".tif", ".tiff"):
        raise ConfigError(f"{output}: name a .csv or a .tiff file", options=("output",))
    if output is not None and output.exists() and output.samefile(command.photo):
        raise ConfigError(f"{output} is the photo itself: name another file", options=("output",))
    photo = read_thermal_photo(command.photo, command.settings.overrides())
    say(*(f"{f'{title}:':<14}{text}" for title, text in _facts(photo)))
    for note in photo.facts.notes:
        print_note(note)
    for warning in photo.facts.warnings:
        print_note(warning, "warning")
    if output is None:
        return
    if photo.temperature_c is None:
        raise ConfigError(
            f"{command.photo} has no °C: state its unit or bounds", options=("unit", "bounds_c")
        )
    say(f"written: {_write(output, photo.temperature_c)}")


def _facts(photo: ThermalPhoto) -> Iterator[tuple[str, str]]:
    facts, values = photo.facts, photo.temperature_c
    height, width = photo.valid.shape
    yield "file", f"{facts.source}, {width}×{height} pixels"
    if facts.camera is not None:
        taken = "" if facts.taken is None else f", {facts.taken:%Y-%m-%d %H:%M:%S} by its clock"
        yield "camera", f"{facts.camera}{taken}"
    if facts.unit is not None:
        yield "unit", f"{facts.unit}, a guess"
    if values is None:
        yield "temperatures", "none: brightness alone"
    elif photo.valid.any():
        quantiles = np.nanquantile(values, (0, 0.5, 1)).tolist()
        low, middle, high = (number_text(each, 2) for each in quantiles)
        yield "temperatures", f"{low} to {high} °C, median {middle} °C"
        for title, index in (("coldest", np.nanargmin(values)), ("hottest", np.nanargmax(values))):
            row, column = np.unravel_index(index, values.shape)
            celsius = number_text(float(values[row, column]), 2)
            yield title, f"{celsius} °C in column {column}, row {row}"
    if missing := int((~photo.valid).sum()):
        yield "masked", f"{missing:,} of {photo.valid.size:,} pixels"
    if (settings := facts.parameters) is not None:
        yield "emissivity", f"{settings.emissivity:g}, reflecting {settings.reflected_c:.1f} °C"
        air = f"{settings.atmospheric_c:.1f} °C and {100 * settings.humidity:.0f} % humidity"
        yield "air", f"{settings.distance_m:g} m of {air}"


def _write(path: Path, celsius: np.ndarray) -> Path:
    if path.suffix.lower() != ".csv":
        return write_float_tiff(path, celsius, "°C")
    rows = (",".join("" if np.isnan(value) else f"{value:.3f}" for value in row) for row in celsius)
    return write_text(path, "\n".join(rows) + "\n")
