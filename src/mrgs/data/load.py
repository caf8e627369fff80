"""Open a scene folder: recognise its layout, check it, and describe it as a Scene; its split, and
the °C of its thermal images."""

from __future__ import annotations

import math
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from mrgs.data.colmap import FOLDERS, MODEL_FOLDERS, largest_model, read_colmap
from mrgs.data.files import Number, contained, on_disk, read_json_object
from mrgs.data.images import (
    NARROW,
    Decoded,
    Kind,
    decode,
    has_eight_bit_levels,
    is_coloured,
    probe,
    with_channels,
)
from mrgs.data.nerfstudio import find_transforms, read_transforms
from mrgs.data.radiometric.measurement import masked
from mrgs.data.radiometric.units import (
    CELSIUS,
    FLOAT_UNITS,
    Unit,
    everyday,
    typical,
    units_named,
    zeros_are_missing,
)
from mrgs.data.sources import (
    Decoder,
    FilenameLists,
    ReadingNotes,
    SceneSource,
    check_files,
    decode_intensities,
    posed_image,
)
from mrgs.data.transforms import BOUNDS_FILES
from mrgs.errors import ConfigError, scene_error, warn_user
from mrgs.scene import THERMAL, Modality, Scene, TemperatureRange, View
from mrgs.scene.point_cloud import RANDOM_POINTS, random_points
from mrgs.scene.radiometry import ZERO_CELSIUS_K
from mrgs.scene.view import evenly_spaced
from mrgs.system.memory import collector_paused
from mrgs.system.typed_json import json_value
from mrgs.system.wording import Message, shown


def load_scene(path: str | Path, *, resolution: int | None = None, seed: int = 0) -> Scene:
    """Read a scene folder.

    Supported are ``transforms.json`` (ThermoScenes, nerfstudio; see ``mrgs.data.nerfstudio``)
    and, where there is none, COLMAP reconstructions (RGBT-Scenes, TI-NSD, plain ``images/``; see
    ``mrgs.data.colmap``). All headers are checked here; pixels are decoded, undistorted to a
    pinhole (``mrgs.scene.lens.pinhole_of``) and reduced only when ``PosedImage.load`` is
    called. Masks come from the file's ``mask_path`` and ``thermal_mask_path``, or from the folders
    ``masks/`` and ``thermal_masks/``: black pixels are not valid.

    Args:
        path: the folder, or its transforms file.
        resolution: images wider than this many pixels are reduced to this width, each for itself;
            None keeps them.
        seed: for the start points, where the files hold none.

    Raises:
        SceneError: the folder cannot be used; one line that names the file and says what to do.
        ConfigError: ``resolution`` is not positive.

    Warns:
        MrgsWarning: an error in the files was repaired. Decisions are in ``Scene.notes`` only.
    """
    if resolution is not None and resolution < 1:
        raise ConfigError(
            f"resolution is {resolution}; it is a width in pixels and must be at least 1"
        )
    try:
        with collector_paused():
            source = _recognise(Path(path))
            scene = _assemble(source, Path(path), resolution, seed)
    except OSError as error:  # a folder that may not be listed, a disk that failed
        raise scene_error(
            error.filename or path, f"cannot be read ({error.strerror}); check its permissions"
        ) from None
    for text in source.notes.repaired:
        warn_user(f"{source.root.name}: {text}")
    return scene


def _recognise(path: Path) -> SceneSource:
    if path.suffix == ".json" and path.is_file():
        root, transforms = path.parent.resolve(), path.parent.resolve() / path.name
        return read_transforms(root, transforms)
    if not path.is_dir():
        raise scene_error(path, "not a folder; give the scene's folder")
    root = path.resolve()
    if file := find_transforms(root):
        return read_transforms(root, file)
    notes = ReadingNotes()
    if model := largest_model(root, notes):
        return read_colmap(root, model, notes)
    looked_for = ", ".join(f"{name}/cameras.bin or .txt" for name in MODEL_FOLDERS)
    raise scene_error(
        root,
        f"no scene found; looked for transforms.json, transforms_thermal.json, {looked_for}; "
        "give the folder that holds one",
    )


def _assemble(source: SceneSource, path: Path, resolution: int | None, seed: int) -> Scene:
    notes = source.notes
    thermal_kinds = _checked_thermal_files(source)
    numbers = IN_CELSIUS
    splits = assign_splits([view.key for view in source.views], source.lists, notes)
    if "train" not in splits:
        raise scene_error(
            source.file, "no view is left for training; check the split lists and the file names"
        )
    temperature = None
    if thermal_kinds:
        temperature = _scale(source, thermal_kinds)
        has_unit = _are_centikelvin(thermal_kinds, temperature, notes)
        if has_unit or check_kinds(thermal_kinds, temperature is not None, notes) == "float":
            numbers = CENTIKELVIN if has_unit else _meaning_of(source, temperature)
            if temperature is None and numbers.unit is not None:
                temperature = _measured_range(source, splits, numbers)

    decoders: dict[Modality, Decoder] = {
        modality: partial(decode_intensities, channels=modality.channels)
        for view in source.views
        for modality in view.images
    }
    decoders[THERMAL] = partial(decode_thermal, temperature=temperature, numbers=numbers)
    by_split: dict[Split, list[View]] = {"train": [], "eval": [], "unused": []}
    names = _unique_names([view.key for view in source.views])
    for name, view, split in zip(names, source.views, splits, strict=True):
        images = {
            modality: posed_image(image, decoders[modality], resolution, modality != THERMAL)
            for modality, image in view.images.items()
        }
        by_split[split].append(View(name, images))
    train, points = tuple(by_split["train"]), source.points
    if points is None:
        notes.decide(
            f"There are no start points: {RANDOM_POINTS} are placed at random before the cameras."
        )
        points = random_points([each for view in train for each in view.cameras.values()], seed)
    return Scene(
        name=source.root.name,
        train=train,
        eval=tuple(by_split["eval"]),
        points=points,
        temperature=temperature,
        notes=tuple(notes.all),
        path=str(path.resolve()),
        resolution=resolution,
        world=source.world,
    )


def _checked_thermal_files(source: SceneSource) -> list[tuple[Path, Kind]]:
    """The files of thermal images and their kinds, after the headers of all images are checked."""
    thermal_kinds = []
    probed = cache(probe)
    for view in source.views:
        for modality, image in view.images.items():
            kind = check_files(image, probed).kind
            if modality == THERMAL:
                thermal_kinds.append((image.path, kind))
    return thermal_kinds


@dataclass(frozen=True)
class Numbers:
    """What the numbers in float images mean, or in those of integers, as ``decode`` scales them.

    Attributes:
        unit: None for values from 0 to 1 of which nothing else is known.
        without_zeros: pixels of exactly 0 are missing, as where an image was warped or undistorted.
    """

    unit: Unit | None = CELSIUS
    without_zeros: bool = False
    are_integers: bool = False


IN_CELSIUS = Numbers()
CENTIKELVIN = Numbers(Unit("kelvin", 100 / 65535), are_integers=True)


def _scale(source: SceneSource, kinds: Sequence[tuple[Path, Kind]]) -> TemperatureRange | None:
    """The scale that the scene states. A colour palette has none, whatever is stated."""
    temperature = read_bounds(source.root, source.notes)
    colour = next((path for path, kind in kinds if kind == "colour"), None)
    if temperature is not None and colour is not None and is_coloured(decode(colour)):
        source.notes.repair(
            "The thermal images show a colour palette, which gives no °C: temperature_bounds.json "
            "is not used. Export them in shades of grey, white for hot."
        )
        return None
    return temperature


def _are_centikelvin(
    kinds: Sequence[tuple[Path, Kind]], temperature: TemperatureRange | None, notes: ReadingNotes
) -> bool:
    """Whether the thermal images hold 16-bit numbers that are read as K × 100: all that were looked
    at are everyday temperatures, a small part of 16 bits. Stated bounds come first, but are then
    doubted."""
    rows = []
    for path, kind in (kinds[at] for at in evenly_spaced(len(kinds))):
        values = decode(path).values if kind == "grey" else None
        if values is None or has_eight_bit_levels(values):
            return False
        rows.append(typical(65535 * values[..., 0].numpy()))
        if not everyday(("kelvin*100",), rows[-1]):
            return False
    found = np.array(rows)
    if np.ptp(found) > NARROW * 65535:
        return False
    low, high = (f"{value / 100 - ZERO_CELSIUS_K:.1f}" for value in (found.min(), found.max()))
    read = f"K × 100 ({low} to {high} °C)".replace("-", "−")
    if temperature is None:
        notes.repair(f"The 16-bit numbers of the thermal images are taken for {read}.")
    else:
        notes.repair(
            f"The 16-bit numbers of the thermal images are taken for shades between the bounds. If "
            f"they are {read}, remove temperature_bounds.json."
        )
    return temperature is None


def _meaning_of(source: SceneSource, temperature: TemperatureRange | None) -> Numbers:
    """What the numbers in the thermal images mean. Those that ``prepare`` has written are °C."""
    images = [view.images[THERMAL] for view in source.views if THERMAL in view.images]
    if any(image.record is not None for image in images):
        return IN_CELSIUS
    some = [decode(images[at].path) for at in evenly_spaced(len(images))]
    arrays = [_celsius(each, Numbers(None))[0] for each in some if each.kind == "float"]
    known = [row for row in map(typical, arrays) if np.isfinite(row).all()]
    low, _, high = usual = np.median(known or np.full((1, 3), np.nan), axis=0)
    has_zero = temperature is not None and temperature.min_c <= 0 <= temperature.max_c
    is_share = bool(low >= 0 and high <= 1) and (temperature is None or temperature.span_c > 3)
    without_zeros = (is_share or not has_zero) and any(map(zeros_are_missing, arrays))
    if without_zeros:
        source.notes.repair("Pixels of exactly 0 in the thermal images are taken for missing ones.")
    if is_share:
        return Numbers(_unit_of_shares(source.notes, temperature), without_zeros)
    if {("kelvin",), ("celsius",)} <= {tuple(everyday(FLOAT_UNITS, row)) for row in known}:
        source.notes.repair(
            "Some thermal images look like °C and some like K; write all of them in °C."
        )
    return Numbers(_unit_of(source.notes, temperature, usual), without_zeros)


def _unit_of_shares(notes: ReadingNotes, temperature: TemperatureRange | None) -> Unit | None:
    """The unit of numbers from 0 to 1; None without bounds."""
    what = "The thermal images hold numbers from 0 to 1, which are taken for"
    if temperature is None:
        notes.repair(f"{what} relative values without °C.")
        return None
    scale = "shares of the scale in temperature_bounds.json"
    notes.repair(f"{what} {scale}; if they are °C, correct the bounds.")
    return Unit("celsius", 1 / temperature.span_c, -temperature.min_c / temperature.span_c)


def _unit_of(
    notes: ReadingNotes, temperature: TemperatureRange | None, numbers: Float[np.ndarray, "3"]
) -> Unit:
    """The unit of temperatures, of which ``numbers`` are ``typical``: °C, unless they are everyday
    temperatures in K only, or only K are near the scene's bounds."""
    likely = everyday(FLOAT_UNITS, numbers)
    if temperature is None and not likely and np.isfinite(numbers).all():
        notes.repair(
            f"The numbers of the thermal images ({numbers[0]:.5g} to {numbers[2]:.5g}) are taken "
            f"for °C; add temperature_bounds.json with their range if they are, or write °C."
        )
    if temperature is not None:
        middles = {text: Unit.parse(text).celsius(numbers)[1] for text in FLOAT_UNITS}
        near = [text for text, c in middles.items() if -1 <= temperature.from_celsius(c) <= 2]
        if "celsius" in near and likely == ["kelvin"]:
            notes.repair(
                "The thermal images are taken for °C, as temperature_bounds.json says, though they "
                "look like K; if they are K, write the bounds in °C."
            )
        likely = near
    if likely != ["kelvin"]:
        return CELSIUS
    low, _, high = (f"{value:.1f}".replace("-", "−") for value in Unit("kelvin").celsius(numbers))
    notes.repair(
        f"The numbers of the thermal images are taken for K, which gives {low} °C to {high} °C; if "
        f"they are °C, add temperature_bounds.json with their range."
    )
    return Unit("kelvin")


def _measured_range(
    source: SceneSource, splits: Sequence[Split], numbers: Numbers
) -> TemperatureRange:
    """The range of the training images, which hold temperatures."""
    pairs = zip(source.views, splits, strict=True)
    paths = [
        view.images[THERMAL].path
        for view, split in pairs
        if split == "train" and THERMAL in view.images
    ]
    if not paths:
        raise scene_error(
            source.file, "no training view has a thermal image; add temperature_bounds.json"
        )
    temperature = bounds_of_images(paths, numbers)
    source.notes.decide(
        Message(
            "There is no temperature_bounds.json: the training images' range is used, {low} °C to "
            "{high} °C.",
            low=f"{temperature.min_c:g}",
            high=f"{temperature.max_c:g}",
        )
    )
    return temperature


def _unique_names(keys: Sequence[str]) -> list[str]:
    """File stems; equal ones with their folders in front, or else with a number behind."""
    stems = [key.rpartition("/")[2] for key in keys]
    count = Counter(stems)
    names: dict[str, None] = {}
    for key, stem in zip(keys, stems, strict=True):
        name = base = key.replace("/", "_") if count[stem] > 1 else stem
        number = 2
        while name in names:
            name, number = f"{base}_{number}", number + 1
        names[name] = None
    return [*names]


Split = Literal["train", "eval", "unused"]

EVAL_EVERY = 8
"""Every eighth view is held out where the files say nothing (as Mip-NeRF 360 and 3DGS do)."""

_WORD = re.compile(r"(?<![a-z])(train|eval|test|val)(?![a-z])")


def assign_splits(keys: Sequence[str], lists: FilenameLists, notes: ReadingNotes) -> list[Split]:
    """The split of each view, by explicit lists of file names; else by the word train, eval, test
    or val in the file's name or else its folder's (where both sides occur); else every
    ``EVAL_EVERY``-th of the sorted keys, paths without extension. The notes receive the rule that
    was used, and conflicts."""

    def side(key: str) -> Literal["train", "eval"] | None:
        folder, _, name = key.lower().rpartition("/")
        for text in (name, folder.rpartition("/")[2]):
            if words := _WORD.findall(text):
                return "train" if words[0] == "train" else "eval"
        return None

    if lists.train is not None or lists.eval is not None:
        return _by_lists(keys, lists, notes)
    sides = [side(key) for key in keys]
    if "train" in sides and "eval" in sides:
        return [side or "train" for side in sides]
    if len(keys) == 1:
        return ["train"]
    text = "No split is given: every {number}th view, in the order of the names, is held out."
    notes.decide(Message(text, number=f"{EVAL_EVERY}"))
    # The images of two cameras go together.
    named = {name for names in FOLDERS.values() for name in names}
    parts = ([part for part in key.split("/") if part.lower() not in named] for key in keys)
    places = ["/".join(each) for each in parts]
    held_out = {*sorted({*places})[::EVAL_EVERY]}
    return ["eval" if place in held_out else "train" for place in places]


def _by_lists(keys: Sequence[str], lists: FilenameLists, notes: ReadingNotes) -> list[Split]:
    """A view in both lists is held out; without a training list, all others are for training."""
    held_out = lists.eval or frozenset()
    train = frozenset(keys) - held_out if lists.train is None else lists.train
    splits: list[Split] = [
        "eval" if key in held_out else "train" if key in train else "unused" for key in keys
    ]
    if train & held_out:
        notes.repair(
            f"{len(train & held_out)} images are listed for training and for evaluation; they are "
            f"held out."
        )
    if missing := (train | held_out) - frozenset(keys):
        notes.repair(
            f"{len(missing)} images of the split lists have no frame (such as {min(missing)}); "
            f"left out."
        )
    if unused := splits.count("unused"):
        notes.decide(f"{unused} frames are in none of the split lists; left out.")
    return splits


def read_bounds(root: Path, notes: ReadingNotes) -> TemperatureRange | None:
    """The scale from ``temperature_bounds.json`` in the scene's folder or in its ``thermal/``; None
    without a file. SceneError if the file does not have two different temperatures, in °C or in the
    ``unit`` that it names."""
    paths = [contained(root, on_disk(root, name), root) for name in BOUNDS_FILES]
    path = next((path for path in paths if os.path.lexists(path)), None)
    if path is None:
        return None
    content = read_json_object(path)
    low, high = (
        json_value(Number, content.get(name), name, path)
        for name in ("absolute_min_temperature", "absolute_max_temperature")
    )
    named_so = (each for each in content.items() if re.search("(^|_)units?($|_)", each[0].lower()))
    if unit := next((value for _, value in named_so if value), None):
        named = units_named([unicodedata.normalize("NFKC", f"unit {unit}")])
        if len(named) != 1 or not isinstance(unit, str) or any(map(str.isdigit, unit)):
            known = "celsius, kelvin or fahrenheit"
            raise scene_error(path, f"unit is {shown(unit)}; use {known}")
        low, high = Unit.parse(named[0]).celsius(np.array([low, high])).tolist()
    elif everyday(FLOAT_UNITS, np.linspace(low, high, 3)) == ["kelvin"]:
        notes.repair(
            f'{path.name} is taken for °C, though it looks like K; if it is, add "unit": "kelvin".'
        )
    if low > high:
        low, high = high, low
        used = f"{low:g} °C to {high:g} °C".replace("-", "−")
        notes.repair(f"{path.name} has its bounds swapped; {used} is used.")
    try:
        return TemperatureRange(low, high)
    except ValueError as error:
        raise scene_error(path, f"{error}; correct the temperatures") from None


def bounds_of_images(paths: Sequence[Path], numbers: Numbers = IN_CELSIUS) -> TemperatureRange:
    """The range of the temperatures in float images, °C, rounded outwards to whole degrees.
    SceneError if an image cannot be decoded, or has no temperature."""
    low, high = math.inf, -math.inf
    for path in paths:
        celsius, valid = _celsius(decode(path), numbers)
        if not valid.any():
            raise scene_error(path, "holds no plausible temperature; replace the file")
        low, high = min(low, float(celsius[valid].min())), max(high, float(celsius[valid].max()))
    return TemperatureRange.around(low, high)


def _celsius(
    image: Decoded, numbers: Numbers
) -> tuple[Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """The °C of a float image, or its relative values, as of a thermal photo: NaN where no
    temperature is plausible."""
    values = image.values[..., 0].numpy().astype(np.float64)
    usable = None if image.valid is None else image.valid.numpy()
    if numbers.without_zeros:
        values[values == 0] = np.nan
    return masked(values if numbers.unit is None else numbers.unit.celsius(values), usable)


def check_kinds(kinds: Sequence[tuple[Path, Kind]], has_bounds: bool, notes: ReadingNotes) -> Kind:
    """The common kind of all thermal images; notes what follows from it. SceneError if some images
    have °C and others do not, and there are no bounds to bring them together."""
    celsius = [path for path, kind in kinds if kind == "float"]
    if celsius and len(celsius) < len(kinds) and not has_bounds:
        raise scene_error(
            celsius[0],
            "holds °C, but other thermal images do not; add temperature_bounds.json, or convert "
            "them",
        )
    if any(kind == "colour" for _, kind in kinds):
        notes.decide(
            "Thermal images have three channels: their luminance is used; it follows the "
            "temperature only if the "
            "colours are shades of grey."
        )
    if celsius:
        return "float"
    if not has_bounds:
        notes.decide(
            "The thermal images hold no °C and no temperature_bounds.json states their range: "
            "values are relative."
        )
    return "grey"


def decode_thermal(
    path: Path,
    least_width: int | None,
    temperature: TemperatureRange | None,
    numbers: Numbers = IN_CELSIUS,
) -> tuple[Float32[Tensor, "h w 1"], Bool[Tensor, "h w"] | None]:
    """Normalised temperatures of an image, and the mask of usable pixels (None if all are).
    Integers span the range already; a float image's are mapped by ``temperature`` and not clamped,
    unless they are relative, without a unit. They are decoded whole whatever ``least_width`` is.
    SceneError if the file cannot be decoded, or has temperatures where no range is known."""
    image = decode(path)
    values, valid, kind = image
    if kind == "colour":
        return with_channels(values, 1), valid
    if kind == "float" or numbers.are_integers:
        celsius, known = _celsius(image, numbers)
        mapped = torch.from_numpy(np.where(known, celsius, np.float32(0)))
        if numbers.unit is not None:
            if temperature is None:
                raise scene_error(
                    path, "holds °C, but the range is not known; add temperature_bounds.json"
                )
            mapped = temperature.from_celsius(mapped)
        return mapped[..., None], None if known.all() else torch.from_numpy(known)
    return values, valid
