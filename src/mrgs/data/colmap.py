"""COLMAP scenes: RGBT-Scenes (``rgb/`` and ``thermal/``), thermal-only ones like TI-NSD, and plain
``images/``.

Where only one image of a pair is registered, both have its camera. Where both are (``rgb/a.jpg``
and ``thermal/a.jpg`` in one reconstruction), each keeps its own. The formats are described in
COLMAP's documentation, "Output Format".
"""

from __future__ import annotations

import re
import struct
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from torch import Tensor

from mrgs.data.cameras import checked_lens, viewmat_from_colmap
from mrgs.data.files import (
    ImageFinder,
    composed,
    contained,
    is_file,
    on_disk,
    read_bytes,
    without_image_suffix,
)
from mrgs.data.images import decode, is_coloured, probe
from mrgs.data.sources import ImageSource, ReadingNotes, SceneSource, ViewSource, point_cloud
from mrgs.data.transforms import BOUNDS_FILES
from mrgs.errors import SceneError, scene_error
from mrgs.scene import RGB, THERMAL, Modality
from mrgs.scene.lens import Lens
from mrgs.system.wording import Message, shown

Row = TypeVar("Row")

MODEL_FOLDERS = (
    "sparse/0", "sparse/1", "colmap/sparse/0", "colmap_sparse/0", "sparse", "colmap/sparse",
    "colmap",
)  # fmt: skip

_PARAMETER_COUNTS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
}
"""Number of parameters of each camera model, in the order of COLMAP's numbers for them."""

_NOT_READ = ("FOV", "THIN_PRISM_FISHEYE")


@dataclass(frozen=True)
class ColmapModel:
    """Folder of a COLMAP reconstruction, and its format (``.txt`` or ``.bin``)."""

    folder: Path
    suffix: str

    def file(self, stem: str) -> Path:
        """The file of the model with this stem."""
        return self.folder / f"{stem}{self.suffix}"


@dataclass(frozen=True, eq=False)
class RegisteredImage:
    """A registered image: name below the image folder, lens, and world-to-camera matrix."""

    name: str
    lens: Lens
    viewmat: Float64[Tensor, "4 4"]


def find_model(root: Path, folders: Sequence[str] = MODEL_FOLDERS) -> ColmapModel | None:
    """The first complete reconstruction among these folders; binary before text, as in COLMAP."""
    for name in folders:
        for suffix in (".bin", ".txt"):
            model = ColmapModel(root / name, suffix)
            if is_file(model.file("cameras")) and is_file(model.file("images")):
                for stem in ("cameras", "images", "points3D"):
                    contained(root, f"{name}/{stem}{suffix}", root)
                return model
    return None


def largest_model(root: Path, notes: ReadingNotes) -> ColmapModel | None:
    """The reconstruction with the most images, where COLMAP has made several (``sparse/0``,
    ``sparse/1`` and so on, each in a world of its own); else that of ``find_model``."""
    first = find_model(root)
    if first is None or not first.folder.name.isdigit():
        return first
    folder = first.folder.parent
    below = folder.relative_to(root)
    names = sorted(each.name for each in folder.iterdir() if each.name.isdigit())
    models = [model for name in names if (model := find_model(root, [f"{below / name}"]))]
    if len(models) == 1:
        return first
    counts = [_registered(model) for model in models]
    largest = models[counts.index(max(counts))]
    notes.decide(
        f"COLMAP has made {len(models)} reconstructions in {below}, each in a world of its own: "
        f"{largest.folder.name} is used, with {max(counts)} images."
    )
    return largest


def _registered(model: ColmapModel) -> int:
    """Number of images of a reconstruction; 0 if unreadable, as an interrupted COLMAP leaves it."""
    try:
        return len(read_images(model))
    except SceneError:
        return 0


def read_images(model: ColmapModel) -> list[RegisteredImage]:
    """The registered images with their lenses, sorted by name. SceneError if a file is damaged, cut
    off, or uses a camera model that is not supported."""
    binary = model.suffix == ".bin"
    file = model.file("cameras")
    rows = _binary_cameras(file) if binary else _text_rows(file, _text_camera)
    lenses = {
        number: _lens(kind, width, height, parameters, f"camera {number}", file)
        for number, kind, width, height, parameters in rows
    }
    file, images = model.file("images"), []
    for pose, number, name in _binary_images(file) if binary else _text_rows(file, _text_image, 2):
        if number not in lenses:
            raise scene_error(
                file,
                f"image {shown(name)} uses camera {number}, which is not there; run COLMAP again",
            )
        place = np.array(pose[:4]), np.array(pose[4:])
        viewmat = viewmat_from_colmap(*place, f"image {shown(name)}", file)
        images.append(RegisteredImage(name.replace("\\", "/"), lenses[number], viewmat))
    return sorted(images, key=lambda image: image.name)


def read_points3d(model: ColmapModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions [N, 3] in COLMAP's world and colours [N, 3] in [0, 1]; empty without a points3D
    file. SceneError if the file is damaged or cut off."""
    file = model.file("points3D")
    if not is_file(file):
        return np.empty((0, 3)), np.empty((0, 3))
    points = _binary_points(file) if model.suffix == ".bin" else _text_rows(file, _text_point)
    rows = np.array(list(points), dtype=np.float64).reshape(-1, 6)
    return rows[:, :3], np.clip(np.nan_to_num(rows[:, 3:]) / 255, 0.0, 1.0)


def _lens(
    model: str, width: int, height: int, parameters: tuple[float, ...], what: str, file: Path
) -> Lens:
    known = [name for name in _PARAMETER_COUNTS if name not in _NOT_READ]
    if model not in known:
        raise scene_error(
            file,
            f"{what} has the model {shown(model)}; undistort with COLMAP, or use one of "
            f"{', '.join(known)}",
        )
    if len(parameters) != _PARAMETER_COUNTS[model]:
        raise scene_error(
            file,
            f"{what} has {len(parameters)} parameters where {model} has "
            f"{_PARAMETER_COUNTS[model]}; correct it",
        )
    if "SIMPLE" in model or "RADIAL" in model:  # one focal length
        parameters = (parameters[0], *parameters)
    fx, fy, cx, cy, *distortion = parameters
    k = [*distortion, 0.0, 0.0, 0.0, 0.0, 0.0]
    if any(distortion[5:]):
        raise scene_error(
            file, f"{what} has the model {model} with k4, k5 or k6; undistort with COLMAP"
        )
    if model.endswith("FISHEYE"):
        lens = Lens(width, height, fx, fy, cx, cy, (k[0], k[1], k[2], k[3]), fisheye=True)
    else:
        lens = Lens(width, height, fx, fy, cx, cy, (k[0], k[1], k[4], 0.0), (k[2], k[3]))
    return checked_lens(lens, what, file)


class _Cursor:
    """Walks over a binary file and never past its end."""

    def __init__(self, file: Path) -> None:
        self.file, self._data, self._offset = file, read_bytes(file), 0

    def take(self, layout: str) -> tuple:
        """The next little-endian values, in the notation of ``struct``."""
        start = self._offset
        self.skip(struct.calcsize("<" + layout))
        return struct.unpack_from("<" + layout, self._data, start)

    def skip(self, size: int) -> None:
        """Skip a number of bytes. SceneError if the file has fewer."""
        self._offset += size
        if self._offset > len(self._data):
            raise scene_error(self.file, "is cut off or damaged; copy it again or run COLMAP again")

    def take_name(self) -> str:
        """The next text up to its zero byte."""
        start, end = self._offset, self._data.find(b"\0", self._offset)
        self.skip((end if end >= 0 else len(self._data)) - start + 1)
        return self._data[start:end].decode("utf-8", "replace")


_Camera = tuple[int, str, int, int, tuple[float, ...]]
"""Number, model, width, height and parameters."""

_Image = tuple[tuple[float, ...], int, str]
"""Quaternion and translation, the camera's number, name."""


def _binary_cameras(file: Path) -> Iterator[_Camera]:
    cursor = _Cursor(file)
    models = dict(enumerate(_PARAMETER_COUNTS))
    for _ in range(*cursor.take("Q")):
        number, model_id, width, height = cursor.take("IiQQ")
        model = models.get(model_id, f"number {model_id}")
        yield number, model, width, height, cursor.take(f"{_PARAMETER_COUNTS.get(model, 0)}d")


def _binary_images(file: Path) -> Iterator[_Image]:
    cursor = _Cursor(file)
    for _ in range(*cursor.take("Q")):
        _, *pose, camera = cursor.take("I7dI")
        name = cursor.take_name()
        cursor.skip(24 * cursor.take("Q")[0])
        yield tuple(pose), camera, name


def _binary_points(file: Path) -> Iterator[tuple[float, ...]]:
    cursor = _Cursor(file)
    for _ in range(*cursor.take("Q")):
        _, *position_and_color, _, track_length = cursor.take("Q3d3BdQ")
        cursor.skip(8 * track_length)
        yield tuple(position_and_color)


def _text_rows(file: Path, read: Callable[[str], Row], lines_each: int = 1) -> Iterator[Row]:
    """What is read from the first line of each record; comments and empty lines are left out."""
    text = read_bytes(file).decode("utf-8-sig", "replace").split("\n")
    lines = (each for each in enumerate(text, 1) if not each[1].startswith("#"))
    for number, line in lines:
        if not line.strip():
            continue
        try:
            yield read(line)
        except (ValueError, IndexError):
            raise scene_error(
                file, f"line {number} is damaged; copy the file again or run COLMAP again"
            ) from None
        for _ in range(lines_each - 1):
            next(lines, None)


def _text_camera(line: str) -> _Camera:
    number, model, width, height, *parameters = line.split()
    return int(number), model, int(width), int(height), tuple(map(float, parameters))


def _text_image(line: str) -> _Image:
    words = line.split(maxsplit=9)
    return tuple(map(float, words[1:8])), int(words[8]), words[9].rstrip()


def _text_point(line: str) -> tuple[float, ...]:
    words = line.split(maxsplit=7)
    return tuple(float(words[index]) for index in range(1, 7))


FOLDERS = {
    RGB: ("rgb", "images"),
    THERMAL: ("thermal", "infrared", "ir", "tir", "lwir", "thermal_images", "images_thermal"),
}
"""Possible folders of each modality's images; the first that exists is used, of the further thermal
ones only if they have names of the RGB images."""

_THERMAL_WORD, _WORD = (
    re.compile(rf"(?i)(?<![a-z])(?:{'|'.join(names)})(?![a-z])[_\-. /]*")
    for names in (FOLDERS[THERMAL], FOLDERS[THERMAL] + FOLDERS[RGB])
)
"""The same names as words of paths, by which the images of one folder are told apart."""

Registered = dict[tuple[Modality, str], RegisteredImage]
"""Registered images by modality and key."""


@dataclass(frozen=True)
class _Images:
    """The image files of one modality by key, and the keys by path below the folder without
    extension: that path, or what is left of it without words for a modality."""

    modality: Modality
    folder: str
    files: dict[str, Path]
    keys: dict[str, str]

    def key_of(self, name: str, is_whole: bool = False) -> str | None:
        """The key of a name in the reconstruction: the whole path, or else, unless that is wanted,
        the file's stem if only one matches; None if there is none."""
        path = without_image_suffix(composed(PurePosixPath(name).as_posix()))
        for candidate in (path, path.removeprefix(f"{self.folder}/")):
            if candidate in self.keys:
                return self.keys[candidate]
        matches = self._by_stem[path.rpartition("/")[2]]
        return matches[0] if len(matches) == 1 and not is_whole else None

    @cached_property
    def _by_stem(self) -> Mapping[str, list[str]]:
        found = defaultdict[str, list[str]](list)
        for path, key in self.keys.items():
            found[path.rpartition("/")[2]].append(key)
        return found

    def without_words(self) -> _Images:
        """The same, with keys without words for a modality, unless two would be equal."""
        keys = {path: _WORD.sub("", path).strip("_-. /") or path for path in self.keys}
        if len({*keys.values()}) < len(keys):
            return self
        return replace(self, keys=keys, files={keys[path]: self.files[path] for path in keys})


def read_colmap(root: Path, model: ColmapModel, notes: ReadingNotes) -> SceneSource:
    """Read a COLMAP scene; images are looked up, not decoded. ``notes`` receives decisions.

    A folder ``images/`` (or ``rgb/``) without a ``thermal/`` beside it holds thermal images if a
    ``temperature_bounds.json`` is there, or if none of its images has colour channels. SceneError
    if the reconstruction is damaged, names no image, or names one that is missing.
    """
    finder = ImageFinder(root)
    file = model.file("images")
    registered = read_images(model)
    if not registered:
        raise scene_error(
            file, "holds no registered image; run COLMAP again with more overlap between the photos"
        )
    images = _image_folders(root, finder, notes)
    found = _match(registered, images, root, finder, file, notes)
    keys = sorted({key for _, key in found})
    if left_out := len({key for each in images for key in each.files}) - len(keys):
        notes.decide(
            Message(
                "{number} images were not registered by COLMAP; left out.", number=f"{left_out}"
            )
        )
    views = [_view(key, found, images, finder) for key in keys]
    return SceneSource(root, file, views, point_cloud(*read_points3d(model), notes), notes)


def _image_folders(root: Path, finder: ImageFinder, notes: ReadingNotes) -> list[_Images]:
    """The image files of each modality that has any, RGB first."""
    images: list[_Images] = []
    for modality, names in FOLDERS.items():
        if modality == THERMAL and (root / "colmap_sparse").is_dir():  # ThermalMix
            names = ("warped_thermal", *names)
        there = [on_disk(root, name) for name in names]
        name = next((name for name in there if (root / name).is_dir()), "")
        files = finder.tree(root / name) if name else {}
        if modality == RGB:
            files = {key: path for key, path in files.items() if path.suffix.lower() != ".npy"}
        is_usual = modality == RGB or name.lower() == "thermal" or not images
        if files and (is_usual or files.keys() & images[0].files.keys()):
            images.append(_Images(modality, name, files, {key: key for key in files}))
    if [each.modality for each in images] != [RGB]:
        is_paired = len(images) < 2 or images[0].files.keys() & images[1].files.keys()
        return images if is_paired else [each.without_words() for each in images]
    own = images[0].files
    is_thermal = {key: _THERMAL_WORD.search(key) is not None for key in own}
    parts = [
        _Images(modality, images[0].folder, files, {key: key for key in files}).without_words()
        for modality in FOLDERS
        if (files := {key: own[key] for key in own if is_thermal[key] == (modality == THERMAL)})
    ]
    of_cameras = {key.partition("/")[0].lower() for key in own} <= {*chain(*FOLDERS.values())}
    if len(parts) == 2 and (of_cameras or parts[0].files.keys() & parts[1].files.keys()):
        notes.decide(f"Images in {images[0].folder}/ are told apart by names like thermal.")
        return parts
    has_bounds = any(is_file(root / on_disk(root, bounds)) for bounds in BOUNDS_FILES)
    first = next(iter(images[0].files.values()))
    if has_bounds or all(probe(path).kind != "colour" for path in images[0].files.values()):
        note = notes.repair if has_bounds and is_coloured(decode(first)) else notes.decide
        note(f"The images in {images[0].folder}/ are taken for thermal ones.")
        return [replace(images[0], modality=THERMAL)]
    return images


def _match(
    registered: Sequence[RegisteredImage],
    images: Sequence[_Images],
    root: Path,
    finder: ImageFinder,
    file: Path,
    notes: ReadingNotes,
) -> Registered:
    """The image files of the registered images; of several formats, the registered one. A name that
    is a whole path, or starts with a folder, is looked up there first, else among RGB first."""
    found: Registered = {}
    for image in registered:
        folder = PurePosixPath(image.name).parts[:1]
        in_folder = sorted(images, key=lambda each: (each.folder,) != folder)
        for each in sorted(in_folder, key=lambda each: each.key_of(image.name, True) is None):
            key = each.key_of(image.name)
            if key is not None:
                name = PurePosixPath(image.name).name
                if (before := found.setdefault((each.modality, key), image)) is image:
                    named = each.files[key].relative_to(root).with_name(name).as_posix()
                    each.files[key] = finder.find(named, file) or each.files[key]
                else:
                    names = f"{shown(before.name)} and {shown(image.name)}"
                    notes.repair(f"{names} are one image with two poses: the first is used.")
                break
        else:
            raise scene_error(
                file,
                f"the registered image {shown(image.name)} is missing in images/, rgb/ and "
                f"thermal/, or there several times; restore it, or remove it from the "
                f"reconstruction",
            )
    return found


def _view(
    key: str, found: Registered, images: Sequence[_Images], finder: ImageFinder
) -> ViewSource:
    """The images of a key; one that is not registered has the camera of the first that is."""
    first = next(found[each.modality, key] for each in images if (each.modality, key) in found)
    sources = {}
    for index, each in enumerate(images):
        if (path := each.files.get(key)) is not None:
            image = found.get((each.modality, key), first)
            masks = f"{each.modality}_masks" if index else "masks"
            mask = finder.find_mask(masks, path.name, path)
            sources[each.modality] = ImageSource(path, image.lens, image.viewmat, mask)
    return ViewSource(key, sources)
