"""COLMAP's reconstructions on disk: cameras, images and points3D, as text or as binary files.

The formats are described in COLMAP's documentation, "Output Format".
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from torch import Tensor

from mrgs.data.files import contained, is_file, read_bytes, scene_error
from mrgs.data.lens import Lens, checked_lens
from mrgs.data.poses import viewmat_from_colmap
from mrgs.errors import SceneError
from mrgs.system.wording import shown

MODEL_FOLDERS = ("sparse/0", "colmap/sparse/0", "sparse", "colmap/sparse", "colmap")

_MODEL_NAMES = {
    0: "SIMPLE_PINHOLE",
    1: "PINHOLE",
    2: "SIMPLE_RADIAL",
    3: "RADIAL",
    4: "OPENCV",
    5: "OPENCV_FISHEYE",
}
_PARAMETER_COUNTS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
}


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
    """An image of the reconstruction: its name below the image folder, lens, and world-to-camera
    matrix."""

    name: str
    lens: Lens
    viewmat: Float64[Tensor, "4 4"]


def find_model(root: Path) -> ColmapModel | None:
    """The first complete reconstruction among ``MODEL_FOLDERS``; binary before text, as in
    COLMAP."""
    for name in MODEL_FOLDERS:
        for suffix in (".bin", ".txt"):
            model = ColmapModel(root / name, suffix)
            if is_file(model.file("cameras")) and is_file(model.file("images")):
                for stem in ("cameras", "images", "points3D"):
                    contained(root, f"{name}/{stem}{suffix}", root)
                return model
    return None


def read_images(model: ColmapModel) -> list[RegisteredImage]:
    """The registered images with their lenses, sorted by name.

    Raises:
        SceneError: a file is damaged, cut off, or uses a camera model that is not supported.
    """
    binary = model.suffix == ".bin"
    cameras = dict((_binary_cameras if binary else _text_cameras)(model.file("cameras")))
    file = model.file("images")
    images = []
    for pose, camera_id, name in (_binary_images if binary else _text_images)(file):
        if camera_id not in cameras:
            raise scene_error(
                file,
                f"image {shown(name)} uses camera {camera_id}, which is not there; run COLMAP "
                f"again",
            )
        viewmat = viewmat_from_colmap(
            np.array(pose[:4]), np.array(pose[4:]), f"image {shown(name)}", file
        )
        images.append(RegisteredImage(name, cameras[camera_id], viewmat))
    return sorted(images, key=lambda image: image.name)


def read_points3d(model: ColmapModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions [N, 3] in COLMAP's world and colours [N, 3] in [0, 1]; empty without a points3D
    file.

    Raises:
        SceneError: the file is damaged or cut off.
    """
    file = model.file("points3D")
    if not is_file(file):
        return np.empty((0, 3)), np.empty((0, 3))
    rows = np.array(
        list((_binary_points if model.suffix == ".bin" else _text_points)(file)), dtype=np.float64
    )
    rows = rows.reshape(-1, 6)
    return rows[:, :3], np.clip(np.nan_to_num(rows[:, 3:]) / 255, 0.0, 1.0)


def _lens(
    model: str, width: int, height: int, parameters: tuple[float, ...], what: str, file: Path
) -> Lens:
    if model not in _PARAMETER_COUNTS:
        known = ", ".join(_PARAMETER_COUNTS)
        raise scene_error(
            file,
            f"{what} has the model {shown(model)}; undistort with COLMAP, or use one of {known}",
        )
    if len(parameters) != _PARAMETER_COUNTS[model]:
        raise scene_error(
            file,
            f"{what} has {len(parameters)} parameters where {model} has "
            f"{_PARAMETER_COUNTS[model]}; correct it",
        )
    if model in {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"}:  # one focal length
        parameters = (parameters[0], *parameters)
    fx, fy, cx, cy, *distortion = parameters
    k = [*distortion, 0.0, 0.0, 0.0, 0.0]
    if model == "OPENCV_FISHEYE":
        lens = Lens(width, height, fx, fy, cx, cy, (k[0], k[1], k[2], k[3]), fisheye=True)
    else:
        lens = Lens(width, height, fx, fy, cx, cy, (k[0], k[1], 0.0, 0.0), (k[2], k[3]))
    return checked_lens(lens, what, file)


class _Cursor:
    """Walks over a binary file and never past its end."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._data = read_bytes(file)
        self._offset = 0

    def take(self, layout: str) -> tuple:
        """The next little-endian values, in the notation of ``struct``."""
        start = self._offset
        self.skip(struct.calcsize("<" + layout))
        return struct.unpack_from("<" + layout, self._data, start)

    def take_count(self, smallest_record: int) -> int:
        """A number of records, if the rest of the file can hold them."""
        (count,) = self.take("Q")
        if count * smallest_record > len(self._data) - self._offset:
            raise self._cut_off()
        return count

    def skip(self, size: int) -> None:
        """Skip a number of bytes."""
        if size > len(self._data) - self._offset:
            raise self._cut_off()
        self._offset += size

    def take_name(self) -> str:
        """The next text up to its zero byte."""
        end = self._data.find(b"\0", self._offset)
        if end < 0:
            raise self._cut_off()
        raw = self._data[self._offset : end]
        self._offset = end + 1
        return raw.decode("utf-8", "replace")

    def _cut_off(self) -> SceneError:
        return scene_error(self.file, "is cut off or damaged; copy it again or run COLMAP again")


def _binary_cameras(file: Path) -> Iterator[tuple[int, Lens]]:
    cursor = _Cursor(file)
    for _ in range(cursor.take_count(24)):
        camera_id, model_id, width, height = cursor.take("IiQQ")
        model = _MODEL_NAMES.get(model_id, f"number {model_id}")
        parameters = cursor.take(f"{_PARAMETER_COUNTS.get(model, 0)}d")
        yield camera_id, _lens(model, width, height, parameters, f"camera {camera_id}", file)


def _binary_images(file: Path) -> Iterator[tuple[tuple[float, ...], int, str]]:
    cursor = _Cursor(file)
    for _ in range(cursor.take_count(73)):
        _, *pose, camera_id = cursor.take("I7dI")
        name = cursor.take_name()
        cursor.skip(24 * cursor.take_count(24))
        yield tuple(pose), camera_id, name


def _binary_points(file: Path) -> Iterator[tuple[float, ...]]:
    cursor = _Cursor(file)
    for _ in range(cursor.take_count(51)):
        _, *position_and_color, _, track_length = cursor.take("Q3d3BdQ")
        cursor.skip(8 * track_length)
        yield tuple(position_and_color)


def _lines(file: Path) -> list[tuple[int, str]]:
    """The lines with their numbers, without comments."""
    text = read_bytes(file).decode("utf-8", "replace")
    return [
        (index, line) for index, line in enumerate(text.split("\n"), 1) if not line.startswith("#")
    ]


@contextmanager
def _parsing(file: Path, number: int) -> Iterator[None]:
    """Turns a missing word, or one that is not a number, into a SceneError."""
    try:
        yield
    except (ValueError, IndexError):
        raise scene_error(
            file, f"line {number} is damaged; copy the file again or run COLMAP again"
        ) from None


def _text_cameras(file: Path) -> Iterator[tuple[int, Lens]]:
    for number, line in _lines(file):
        words = line.split()
        if not words:
            continue
        with _parsing(file, number):
            camera_id, model, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
            parameters = tuple(float(word) for word in words[4:])
        yield camera_id, _lens(model, width, height, parameters, f"camera {camera_id}", file)


def _text_images(file: Path) -> Iterator[tuple[tuple[float, ...], int, str]]:
    """Two lines per image; the second one lists its points, may be empty, and is not needed."""
    lines = iter(_lines(file))
    for number, line in lines:
        words = line.split(maxsplit=9)
        if not words:
            continue
        with _parsing(file, number):
            pose = tuple(float(word) for word in words[1:8])
            camera_id, name = int(words[8]), words[9].rstrip()
        next(lines, None)
        yield pose, camera_id, name


def _text_points(file: Path) -> Iterator[tuple[float, ...]]:
    for number, line in _lines(file):
        words = line.split(maxsplit=7)
        if not words:
            continue
        with _parsing(file, number):
            point = tuple(float(word) for word in words[1:7])
            if len(point) < 6:
                raise IndexError
        yield point
