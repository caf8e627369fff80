"""COLMAP scenes: RGBT-Scenes (``rgb/`` and ``thermal/``), thermal-only ones like TI-NSD, and plain
``images/``.

Where only one image of a pair is registered, its camera serves both. Where both are (``rgb/a.jpg``
and ``thermal/a.jpg`` in one reconstruction), each keeps its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from mrgs.data.capture import Capture, ImageSource, Notes, Shot
from mrgs.data.colmap_model import ColmapModel, RegisteredImage, read_images, read_points3d
from mrgs.data.files import ImageFinder, is_file, scene_error, shown, without_image_suffix
from mrgs.data.images import probe
from mrgs.data.points import point_cloud
from mrgs.data.thermal import BOUNDS_FILES
from mrgs.scene import RGB, THERMAL

RGB_FOLDERS = ("rgb", "images")
THERMAL_FOLDER = "thermal"


@dataclass(frozen=True)
class _Images:
    """The image files of one modality by key: path below the folder without extension."""

    folder: str
    files: dict[str, Path]

    def key_of(self, name: str) -> str | None:
        """The key that a name in the reconstruction stands for: the whole path, or the file's stem
        if only one fits."""
        path = without_image_suffix(PurePosixPath(name).as_posix())
        for candidate in (path, path.removeprefix(f"{self.folder}/")):
            if candidate in self.files:
                return candidate
        stem = path.rpartition("/")[2]
        matches = [key for key in self.files if key.rpartition("/")[2] == stem]
        return matches[0] if len(matches) == 1 else None


def read_colmap(root: Path, model: ColmapModel) -> Capture:
    """Understand a COLMAP scene; images are looked up, not decoded.

    A folder ``images/`` (or ``rgb/``) without a ``thermal/`` beside it is taken for thermal images
    where a ``temperature_bounds.json`` is there, or where none of its images has colour channels.

    Args:
        root: the scene's folder, resolved.
        model: the reconstruction.

    Raises:
        SceneError: the reconstruction is damaged, names no image, or names one that is missing.
    """
    notes = Notes()
    finder = ImageFinder(root)
    file = model.file("images")
    registered = read_images(model)
    if not registered:
        raise scene_error(
            file, "holds no registered image; run COLMAP again with more overlap between the photos"
        )
    rgb, thermal = _image_folders(root, finder, notes)
    found = _match(registered, rgb, thermal, file)
    if left_out := len(rgb.files.keys() | thermal.files.keys()) - len({key for _, key in found}):
        notes.decide(f"{left_out} images were not registered by COLMAP; left out.")
    shots = [_shot(key, found, rgb, thermal, finder) for key in sorted({key for _, key in found})]
    return Capture(root, file, shots, point_cloud(*read_points3d(model), notes), notes)


def _image_folders(root: Path, finder: ImageFinder, notes: Notes) -> tuple[_Images, _Images]:
    """The files of the RGB and of the thermal images; one of the two may be empty."""
    thermal = _Images(THERMAL_FOLDER, finder.tree(root / THERMAL_FOLDER))
    name = next((name for name in RGB_FOLDERS if (root / name).is_dir()), "")
    rgb = _Images(name, finder.tree(root / name) if name else {})
    if thermal.files or not rgb.files:
        return rgb, thermal
    has_bounds = any(is_file(root / bounds) for bounds in BOUNDS_FILES)
    if has_bounds or all(probe(path).kind != "colour" for path in rgb.files.values()):
        notes.decide(f"The images in {name}/ are taken for thermal ones.")
        return _Images("", {}), rgb
    return rgb, thermal


def _match(
    registered: list[RegisteredImage], rgb: _Images, thermal: _Images, file: Path
) -> dict[tuple[str, str], RegisteredImage]:
    """Registered images by modality folder and key.

    A name is looked up among the RGB images first, unless it starts with the thermal folder's name.
    """
    found: dict[tuple[str, str], RegisteredImage] = {}
    for image in registered:
        named_thermal = PurePosixPath(image.name).parts[:1] == (THERMAL_FOLDER,)
        for images in (thermal, rgb) if named_thermal else (rgb, thermal):
            key = images.key_of(image.name)
            if key is not None:
                found[images.folder, key] = image
                break
        else:
            raise scene_error(
                file,
                f"the registered image {shown(image.name)} is missing in images/, rgb/ and "
                f"thermal/, or there several "
                "times; restore it, or remove it from the reconstruction",
            )
    return found


def _shot(
    key: str,
    found: dict[tuple[str, str], RegisteredImage],
    rgb: _Images,
    thermal: _Images,
    finder: ImageFinder,
) -> Shot:
    rgb_image, thermal_image = found.get((rgb.folder, key)), found.get((thermal.folder, key))
    sole = rgb_image or thermal_image
    thermal_masks = "thermal_masks" if rgb.files else "masks"
    return Shot(
        key,
        {
            modality: source
            for modality, images, image, masks in (
                (RGB, rgb, rgb_image, "masks"),
                (THERMAL, thermal, thermal_image, thermal_masks),
            )
            if (source := _source(images.files.get(key), image or sole, masks, finder))
        },
    )


def _source(
    path: Path | None, image: RegisteredImage | None, mask_folder: str, finder: ImageFinder
) -> ImageSource | None:
    if path is None or image is None:
        return None
    return ImageSource(
        path, image.lens, image.viewmat, finder.find_mask(mask_folder, path.name, path)
    )
