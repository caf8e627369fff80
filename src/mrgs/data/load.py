"""Open a scene folder: recognise its layout, check it, and describe it as a Scene."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Literal

from jaxtyping import Bool, Float32
from torch import Tensor

from mrgs.data.colmap import read_colmap
from mrgs.data.colmap_model import MODEL_FOLDERS, find_model
from mrgs.data.files import scene_error
from mrgs.data.images import Kind, probe
from mrgs.data.nerfstudio import find_transforms, read_transforms
from mrgs.data.posed import Decoder, check_files, decode_intensities, posed_image
from mrgs.data.sources import FilenameLists, ReadingNotes, SceneSource, ViewSource
from mrgs.data.thermal import bounds_of_images, check_kinds, decode_thermal, read_bounds
from mrgs.errors import ConfigError, warn_user
from mrgs.scene import THERMAL, Modality, Scene, TemperatureRange, View
from mrgs.scene.point_cloud import RANDOM_POINTS, PointCloud, random_points
from mrgs.system.memory import collector_paused
from mrgs.system.wording import Message


def load_scene(path: str | Path, *, resolution: int | None = None, seed: int = 0) -> Scene:
    """Read a scene folder.

    Supported are ``transforms.json`` (ThermoScenes, nerfstudio; see ``mrgs.data.nerfstudio``)
    and, where there is none, COLMAP reconstructions (RGBT-Scenes, TI-NSD, plain ``images/``; see
    ``mrgs.data.colmap``). All headers are checked here; pixels are decoded, undistorted to a
    pinhole (``mrgs.data.undistort.pinhole_of``) and reduced only when ``PosedImage.load`` is
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
    if model := find_model(root):
        return read_colmap(root, model)
    looked_for = ", ".join(f"{name}/cameras.bin or .txt" for name in MODEL_FOLDERS)
    raise scene_error(
        root,
        f"no scene found; looked for transforms.json, transforms_thermal.json, {looked_for}; "
        "give the folder that holds one",
    )


def _assemble(source: SceneSource, path: Path, resolution: int | None, seed: int) -> Scene:
    thermal_kinds = _checked_thermal_files(source)
    splits = _checked_splits(source)
    temperature = _temperature_range(source, thermal_kinds, splits) if thermal_kinds else None
    names = _unique_names([view.key for view in source.views])
    views = [
        _view(name, view, temperature, resolution)
        for name, view in zip(names, source.views, strict=True)
    ]
    train = tuple(view for view, split in zip(views, splits, strict=True) if split == "train")
    points = _start_points(source, train, seed) if source.points is None else source.points
    return Scene(
        name=source.root.name,
        train=train,
        eval=tuple(view for view, split in zip(views, splits, strict=True) if split == "eval"),
        points=points,
        temperature=temperature,
        notes=tuple(source.notes.all),
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


def _checked_splits(source: SceneSource) -> list[Split]:
    """The split of each view; some are for training."""
    splits = assign_splits([view.key for view in source.views], source.lists, source.notes)
    if "train" not in splits:
        raise scene_error(
            source.file, "no view is left for training; check the split lists and the file names"
        )
    return splits


def _temperature_range(
    source: SceneSource, thermal_kinds: Sequence[tuple[Path, Kind]], splits: Sequence[Split]
) -> TemperatureRange | None:
    """The range of the thermal images; None where they are normalised and no file gives it."""
    temperature = read_bounds(source.root, source.notes)
    kind = check_kinds(thermal_kinds, temperature is not None, source.notes)
    if kind == "float" and temperature is None:
        return _measured_range(source, splits)
    return temperature


def _start_points(source: SceneSource, train: Sequence[View], seed: int) -> PointCloud:
    """Random points before the training cameras, in place of those that the files lack."""
    source.notes.decide(
        f"There are no start points: {RANDOM_POINTS} are placed at random before the cameras."
    )
    return random_points([camera for view in train for camera in view.cameras.values()], seed)


def _measured_range(source: SceneSource, splits: Sequence[Split]) -> TemperatureRange:
    """The range of the training images, which hold °C."""
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
    temperature = bounds_of_images(paths)
    source.notes.decide(
        Message(
            "There is no temperature_bounds.json: the training images' range is used, {low} °C to "
            "{high} °C.",
            low=f"{temperature.min_c:g}",
            high=f"{temperature.max_c:g}",
        )
    )
    return temperature


def _view(
    name: str, view: ViewSource, temperature: TemperatureRange | None, resolution: int | None
) -> View:
    return View(
        name,
        {
            modality: posed_image(
                image, _decoder(modality, temperature), resolution, modality != THERMAL
            )
            for modality, image in view.images.items()
        },
    )


def _decoder(modality: Modality, temperature: TemperatureRange | None) -> Decoder:
    """Temperatures are decoded with their range, all other modalities as intensities."""
    if modality == THERMAL:
        return partial(_temperatures, temperature=temperature)
    return partial(decode_intensities, channels=modality.channels)


def _temperatures(
    path: Path, least_width: int | None, temperature: TemperatureRange | None
) -> tuple[Float32[Tensor, "h w 1"], Bool[Tensor, "h w"] | None]:
    """Temperatures are measured, and so decoded whole."""
    return decode_thermal(path, temperature)


def _unique_names(keys: Sequence[str]) -> list[str]:
    """File stems; where two are equal, with their folders in front; where that fails too, with a
    number behind."""
    stems = [key.rpartition("/")[2] for key in keys]
    shared = {stem for stem, count in Counter(stems).items() if count > 1}
    names: list[str] = []
    taken: set[str] = set()
    for key, stem in zip(keys, stems, strict=True):
        base = key.replace("/", "_") if stem in shared else stem
        name = base
        number = 2
        while name in taken:
            name = f"{base}_{number}"
            number += 1
        taken.add(name)
        names.append(name)
    return names


Split = Literal["train", "eval", "unused"]

EVAL_EVERY = 8
"""Every eighth view is held out where the files say nothing (Mip-NeRF 360's and 3DGS's
convention)."""

_WORD = re.compile(r"(?<![a-z])(train|eval|test|val)(?![a-z])")


def assign_splits(keys: Sequence[str], lists: FilenameLists, notes: ReadingNotes) -> list[Split]:
    """The split of each view.

    In this order: explicit lists of file names; the word train, eval, test or val in the file's
    name or else in its folder's (where both sides occur); every ``EVAL_EVERY``-th of the sorted
    keys.

    Args:
        keys: paths without extension, one per view.
        lists: explicit lists, as far as the files give them.
        notes: receives the rule that was used, and conflicts.
    """
    if lists.train is not None or lists.eval is not None:
        return _by_lists(keys, lists, notes)
    sides = [_side(key) for key in keys]
    if "train" in sides and "eval" in sides:
        return [side or "train" for side in sides]
    if len(keys) == 1:
        return ["train"]
    notes.decide(
        Message(
            "No split is given: every {number}th view, in the order of the names, is held out.",
            number=f"{EVAL_EVERY}",
        )
    )
    held_out = set(sorted(range(len(keys)), key=lambda index: keys[index])[::EVAL_EVERY])
    return ["eval" if index in held_out else "train" for index in range(len(keys))]


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


def _side(key: str) -> Literal["train", "eval"] | None:
    folder, _, name = key.lower().rpartition("/")
    for text in (name, folder.rpartition("/")[2]):
        if words := _WORD.findall(text):
            return "train" if words[0] == "train" else "eval"
    return None
