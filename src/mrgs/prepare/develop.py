"""Photos in, the scene's images out: RGB as the camera wrote it, and float32 °C where the thermal
photo holds them."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from mrgs.data.files import read_bytes, scene_error
from mrgs.data.radiometric import ExifFacts, Overrides, ThermalPhoto, read_exif, read_thermal_photo
from mrgs.data.radiometric.measurement import PARAMETER_LIMITS
from mrgs.errors import SceneError
from mrgs.prepare.contract import DevelopedView, Development, LeftOut, Pairing, PhotoPair, Progress
from mrgs.prepare.rgb_photo import RgbPhoto, common_orientation, read_embedded, read_rgb, turned
from mrgs.prepare.store import fingerprint, load, save
from mrgs.system.atomic import remove, replacing

FOLDERS = ("images", "thermal")
RECORDS = Path("prepare", "photos")
"""In the scene's folder: a file for each view, which says what it was made from."""

_VERSION = 1
"""Raised when the images change that the same photos give."""

_UNIT_NOTE = re.compile(r"The numbers are taken for (\S+)\.")


@dataclass(frozen=True)
class Record:
    """A view that was developed, with what is compared between the views.

    Attributes:
        view: the view.
        rgb_size: width and height in pixels; None without an RGB photo.
        thermal_size: width and height in pixels.
        parameters: of the computation of the temperatures, by name; None for finished numbers.
    """

    view: DevelopedView
    rgb_size: tuple[int, int] | None
    thermal_size: tuple[int, int]
    parameters: dict[str, float] | None


class _Set(NamedTuple):
    """What holds for all photos of the set."""

    scene: Path
    overrides: Overrides
    units: dict[str, str]
    rgb_turn: int
    thermal_turn: int

    def overrides_for(self, pair: PhotoPair) -> Overrides:
        """The user's, with the unit of the set."""
        unit = self.units.get(pair.thermal.suffix.lower())
        return self.overrides if unit is None else dataclasses.replace(self.overrides, unit=unit)


def develop(
    pairing: Pairing, scene: Path, overrides: Overrides, progress: Progress, *, turns: bool = True
) -> Development:
    """Read all photos, and write them into ``images`` and ``thermal`` of the scene's folder.

    What an earlier call wrote is kept where the photos and the overrides are the same. A pair with
    a photo that cannot be read is left out. The unit of numbers, if no one says it, and the
    orientation are one for all photos.

    Args:
        pairing: the photos; they are only read.
        scene: the scene's folder, made if need be. It is the program's own: images of views' names
            are replaced.
        overrides: what the user knows better than the thermal photos.
        progress: told about each view.
        turns: turn the images upright by their EXIF orientation; else they stay as they are stored,
            as given poses and lenses take them.

    Raises:
        SceneError: no photo can be used, the photos lie where the scene's images go, or are of
            different cameras.
        RunError: the scene's folder cannot be written (permissions, a full disk); what is there is
            whole, and the next call goes on.
    """
    _check_apart(pairing, scene)
    photos = _Set(
        scene,
        overrides,
        _units(pairing, overrides),
        common_orientation(pair.rgb for pair in pairing.pairs if turns and pair.rgb is not None),
        common_orientation(pair.thermal for pair in pairing.pairs if turns),
    )
    _remove_others(scene, {pair.name for pair in pairing.pairs})
    records: list[Record] = []
    left_out: list[LeftOut] = []
    for index, pair in enumerate(pairing.pairs):
        progress("reading and writing", index, len(pairing.pairs))
        try:
            records.append(_developed(pair, photos))
        except SceneError as error:
            left_out.append(LeftOut(pair.name, str(error)))
    progress("reading and writing", len(pairing.pairs), len(pairing.pairs))
    if not records:
        first = f"; the first: {left_out[0].reason}" if left_out else "; find pairs first"
        raise SceneError(f"none of the {len(pairing.pairs)} pairs can be used{first}")
    records, without = _of_one_kind(records)
    left_out += without
    for item in left_out:
        _remove(scene, item.name)
    _check_sizes(records, pairing)
    return Development(tuple(one.view for one in records), tuple(left_out), _warnings(records))


def _check_apart(pairing: Pairing, scene: Path) -> None:
    """Photos must not lie where the scene's images are written.

    Raises:
        SceneError: one does.
    """
    own = [(scene / name).resolve() for name in (*FOLDERS, RECORDS)]
    for path in (
        path for pair in pairing.pairs for path in (pair.rgb, pair.thermal) if path is not None
    ):
        if any(path.resolve().is_relative_to(folder) for folder in own):
            raise scene_error(
                path,
                f"lies where the images of {scene} are written; choose another folder for the "
                f"scene",
            )


def _units(pairing: Pairing, overrides: Overrides) -> dict[str, str]:
    """The unit of the first photo of each format that can be read, so that it is not guessed for
    each photo anew."""
    units: dict[str, str] = {}
    known = set[str]()
    if overrides.unit is not None or overrides.bounds_c is not None:
        return units
    for pair in pairing.pairs:
        suffix = pair.thermal.suffix.lower()
        if suffix in known:
            continue
        try:
            notes = read_thermal_photo(pair.thermal, overrides).facts.notes
        except SceneError:  # it is told when it is developed
            continue
        known.add(suffix)
        for found in filter(None, map(_UNIT_NOTE.fullmatch, notes)):
            units[suffix] = found[1]
    return units


def _developed(pair: PhotoPair, photos: _Set) -> Record:
    """The pair's images, written if they are not there yet.

    Raises:
        SceneError: a photo cannot be read, or changes meanwhile.
    """
    stamp = _stamp(pair)
    overrides = photos.overrides_for(pair)
    made_from = fingerprint(
        _VERSION, stamp, pair.embedded, overrides, photos.rgb_turn, photos.thermal_turn
    )
    file = _record_file(photos.scene, pair.name)
    known = load(file, Record, made_from)
    if known is not None and all((photos.scene / name).is_file() for name in _files(known.value)):
        return known.value
    rgb, thermal, exif = _read(pair, photos)
    if _stamp(pair) != stamp:
        raise scene_error(
            pair.thermal,
            "this photo or its RGB photo changed while it was read; wait until it is copied",
        )
    record = _written(pair, rgb, thermal, exif, photos)
    save(file, record, made_from)
    return record


def _stamp(pair: PhotoPair) -> list[tuple[str, int, int]]:
    """Path, bytes and time of change (ns) of the pair's files.

    Raises:
        SceneError: one is gone.
    """
    found = []
    for path in (pair.rgb, pair.thermal):
        if path is not None:
            try:
                status = path.stat()
            except OSError as error:
                raise scene_error(
                    path, f"cannot be read ({error.strerror}); it was there before, put it back"
                ) from None
            found.append((str(path), status.st_size, status.st_mtime_ns))
    return found


def _read(pair: PhotoPair, photos: _Set) -> tuple[RgbPhoto | None, ThermalPhoto, ExifFacts]:
    """The RGB photo, the thermal photo, and what EXIF says of the two.

    Raises:
        SceneError: one cannot be read, or there is no visible photo inside the thermal one.
    """
    thermal = read_thermal_photo(pair.thermal, photos.overrides_for(pair))
    facts = thermal.facts
    rgb = None
    if pair.rgb is not None:
        rgb = read_rgb(pair.rgb, photos.rgb_turn)
    elif pair.embedded:
        if facts.visible is None:
            raise scene_error(
                pair.thermal,
                "holds no visible photo, while others do; leave it out, or add its RGB photo",
            )
        rgb = read_embedded(facts.visible, photos.thermal_turn)
    exif = rgb.exif if rgb is not None else ExifFacts()
    of_file = read_exif(read_bytes(pair.thermal))
    known = ExifFacts(of_file.make, of_file.model or facts.camera, facts.taken, facts.gps)
    return rgb, thermal, _completed(exif, known)


def _completed(exif: ExifFacts, by: ExifFacts) -> ExifFacts:
    """What one photo does not say, by the other; maker and model are of one camera."""
    make, model = (exif.make, exif.model) if exif.model is not None else (by.make, by.model)
    return ExifFacts(make, model, exif.taken or by.taken, exif.gps or by.gps)


def _written(
    pair: PhotoPair, rgb: RgbPhoto | None, thermal: ThermalPhoto, exif: ExifFacts, photos: _Set
) -> Record:
    """The record of the images, which are written.

    Raises:
        RunError: the scene's folder cannot be written.
    """
    celsius = thermal.temperature_c
    image = turned(Image.fromarray(_pixels(thermal)), photos.thermal_turn)
    rgb_name = None if rgb is None else f"images/{pair.name}{rgb.suffix}"
    thermal_name = f"thermal/{pair.name}{'.png' if celsius is None else '.tiff'}"
    if rgb is not None and rgb_name is not None:
        with replacing(photos.scene / rgb_name) as temporary:
            temporary.write_bytes(rgb.content)
    with replacing(photos.scene / thermal_name) as temporary:
        image.save(temporary)
    _remove(photos.scene, pair.name, keep=(rgb_name, thermal_name))
    facts, unit = thermal.facts, photos.units.get(pair.thermal.suffix.lower())
    view = DevelopedView(
        pair.name,
        rgb_name,
        thermal_name,
        exif,
        facts.camera,
        None if celsius is None else (float(np.nanmin(celsius)), float(np.nanmax(celsius))),
        (*facts.notes, *([] if unit is None else [f"The numbers are taken for {unit}."])),
        facts.warnings,
    )
    parameters = None if facts.parameters is None else dataclasses.asdict(facts.parameters)
    if parameters is not None and parameters["window_transmission"] == 1:
        parameters["window_c"] = 0.0  # without a window it has no effect
    return Record(view, None if rgb is None else rgb.size, image.size, parameters)


def _pixels(thermal: ThermalPhoto) -> Float32[np.ndarray, "h w"] | UInt8[np.ndarray, "h w"]:
    """Float32 °C, NaN where there is no temperature; or 8-bit shades of grey."""
    if thermal.temperature_c is not None:
        return np.where(thermal.valid, thermal.temperature_c, np.float32(np.nan))
    if thermal.relative is None:
        raise ValueError("a thermal photo holds either temperatures or relative values")
    return np.rint(255 * thermal.relative).astype(np.uint8)


def _record_file(scene: Path, name: str) -> Path:
    return scene / RECORDS / f"{name}.safetensors"


def _files(record: Record) -> tuple[str, ...]:
    return tuple(name for name in (record.view.rgb, record.view.thermal) if name is not None)


def _remove_others(scene: Path, names: set[str]) -> None:
    """Remove the images of views that an earlier call made and that are no more."""
    folder = scene / RECORDS
    for file in sorted(folder.glob("*.safetensors")) if folder.is_dir() else ():
        if file.stem not in names:
            _remove(scene, file.stem)
            remove(file)


def _remove(scene: Path, name: str, keep: Iterable[str | None] = ()) -> None:
    """Remove a view's images, but for those to keep: one of another format would be taken for the
    view's, too."""
    kept = {scene / path for path in keep if path is not None}
    for folder in FOLDERS:
        for suffix in (".jpg", ".png", ".tiff"):
            path = scene / folder / f"{name}{suffix}"
            if path not in kept:
                remove(path)


def _of_one_kind(records: Sequence[Record]) -> tuple[list[Record], list[LeftOut]]:
    """The views with temperatures, if any has them: the others could not be compared with them."""
    with_c = [record for record in records if record.view.range_c is not None]
    if not with_c or len(with_c) == len(records):
        return list(records), []
    reason = "its thermal photo holds no temperatures, while those of others do"
    return with_c, [
        LeftOut(record.view.name, reason) for record in records if record.view.range_c is None
    ]


def _check_sizes(records: Sequence[Record], pairing: Pairing) -> None:
    """One camera for all RGB photos, and one for all thermal photos.

    Raises:
        SceneError: two photos of a kind have different sizes.
    """
    photo = {pair.name: pair for pair in pairing.pairs}
    size_of: tuple[Callable[[Record], tuple[int, int] | None], ...] = (
        lambda r: r.rgb_size,
        lambda r: r.thermal_size,
    )
    for what, size in zip(("RGB", "thermal"), size_of, strict=True):
        groups: dict[tuple[int, int] | None, list[Record]] = {}
        for record in records:
            groups.setdefault(size(record), []).append(record)
        if len(groups) > 1:
            most, other = sorted(groups.values(), key=len, reverse=True)[:2]
            one, two = (photo[group[0].view.name] for group in (most, other))
            first, second = (
                (pair.rgb or pair.thermal) if what == "RGB" else pair.thermal for pair in (one, two)
            )
            raise scene_error(
                second,
                f"its {what} image has {_text(size(other[0]))} pixels, while {len(most)} such as "
                f"{first.name} have "
                f"{_text(size(most[0]))}; photos of two cameras cannot be one scene, remove those "
                f"of one",
            )


def _text(size: tuple[int, int] | None) -> str:
    return "no" if size is None else f"{size[0]} x {size[1]}"


def _warnings(records: Sequence[Record]) -> tuple[str, ...]:
    """What is to be said about the whole set."""
    found = []
    for name in PARAMETER_LIMITS:
        values = {
            round(record.parameters[name], 4) for record in records if record.parameters is not None
        }
        if len(values) > 1:
            found.append(
                f"{name} differs between the photos ({min(values):g} to {max(values):g}): one "
                f"surface then has several "
                "temperatures. Give one value for all."
            )
    return tuple(found)
