"""The one way in: a thermal photo of any kind that is known."""

from __future__ import annotations

from pathlib import Path

from mrgs.data.files import read_bytes, scene_error
from mrgs.data.radiometric import fff, jpeg
from mrgs.data.radiometric.dji import needs_converting, read_bare_numbers
from mrgs.data.radiometric.exif import ExifFacts, read_exif
from mrgs.data.radiometric.flir import read_flir
from mrgs.data.radiometric.photo import Overrides, ThermalPhoto
from mrgs.data.radiometric.raster import read_raster
from mrgs.data.radiometric.table import read_table

MAX_BYTES = 256 * 2**20

_RASTERS = (b"\x89PNG\r\n\x1a\n", b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_TABLE_SUFFIXES = {".csv", ".txt", ".tsv"}


def read_thermal_photo(path: Path, overrides: Overrides | None = None) -> ThermalPhoto:
    """The temperatures of a thermal photo, and what its file says besides. The content decides the
    kind, not the name.

    Args:
        path: a FLIR radiometric JPEG or FFF file; a TIFF, PNG or JPEG image; a table (``.csv``,
            ``.txt``, ``.tsv``); or the bare numbers of DJI's tool (``.raw``).
        overrides: what the user knows better than the file.

    Raises:
        SceneError: the file cannot be read: empty, damaged, cut off, of an unknown kind or scale,
            or a DJI R-JPEG.
    """
    overrides = overrides or Overrides()
    photo = _read(read_bytes(path, MAX_BYTES), path, overrides)
    return _with_unused(photo, overrides)


def _read(data: bytes, path: Path, overrides: Overrides) -> ThermalPhoto:
    if not data:
        raise scene_error(path, "is empty; copy the photo from the camera again")
    if data.startswith(jpeg.SIGNATURE):
        exif = read_exif(data)
        if record := jpeg.flir_record(data, path):
            return read_flir(record, path, exif, overrides)
        if jpeg.holds_dji_signal(data, exif.make):
            raise needs_converting(path)
        return read_raster(data, path, exif, overrides)
    if data.startswith(fff.SIGNATURES):
        return read_flir(data, path, ExifFacts(), overrides)
    if data.startswith(_RASTERS):
        return read_raster(data, path, read_exif(data), overrides)
    if path.suffix.lower() in _TABLE_SUFFIXES:
        return read_table(data, path, overrides)
    if path.suffix.lower() == ".raw":
        return read_bare_numbers(data, path, overrides)
    raise scene_error(
        path, "is not an image; thermal photos are JPEG, PNG, TIFF or FFF files, or tables (.csv)"
    )


def _with_unused(photo: ThermalPhoto, overrides: Overrides) -> ThermalPhoto:
    """Says which of the user's values had no effect."""
    if photo.facts.parameters is None:
        unused = [*overrides.of_parameters()]
        why = "the file holds finished numbers, not the camera's signal"
    else:
        unused = [name for name in ("unit", "bounds_c") if getattr(overrides, name) is not None]
        why = "the temperatures follow from the camera's signal"
    if not unused:
        return photo
    sentence = f"{', '.join(unused)} had no effect: {why}."
    return ThermalPhoto(
        photo.temperature_c, photo.relative, photo.valid, photo.facts.adding(warnings=(sentence,))
    )
