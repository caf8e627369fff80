"""COLMAP scenes: RGBT-Scenes (``rgb/`` and ``thermal/``), thermal-only ones like TI-NSD, and plain
``images/``.

Where only one image of a pair is registered, both have its camera. Where both are (``rgb/a.jpg``
and ``thermal/a.jpg`` in one reconstruction), each keeps its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from mrgs.data.colmap_model import ColmapModel, RegisteredImage, read_images, read_points3d
from mrgs.data.files import ImageFinder, is_file, scene_error, without_image_suffix
from mrgs.data.images import probe
from mrgs.data.sources import ImageSource, ReadingNotes, SceneSource, ViewSource, point_cloud
from mrgs.data.thermal import BOUNDS_FILES
from mrgs.scene import RGB, THERMAL, Modality
from mrgs.system.wording import Message, shown

FOLDERS = {RGB: ("rgb", "images"), THERMAL: ("thermal",)}
"""Possible folders of each modality's images; the first that exists is used."""

Registered = dict[tuple[Modality, str], RegisteredImage]
"""Registered images by modality and key."""


@dataclass(frozen=True)
class _Images:
    """The image files of one modality by key: path below the folder without extension."""

    modality: Modality
    folder: str
    files: dict[str, Path]

    def key_of(self, name: str) -> str | None:
        """The key of a name in the reconstruction: the whole path, or the file's stem if only one
        matches; None if there is none."""
        path = without_image_suffix(PurePosixPath(name).as_posix())
        for candidate in (path, path.removeprefix(f"{self.folder}/")):
            if candidate in self.files:
                return candidate
        stem = path.rpartition("/")[2]
        matches = [key for key in self.files if key.rpartition("/")[2] == stem]
        return matches[0] if len(matches) == 1 else None


def read_colmap(root: Path, model: ColmapModel) -> SceneSource:
    """Read a COLMAP scene; images are looked up, not decoded.

    A folder ``images/`` (or ``rgb/``) without a ``thermal/`` beside it holds thermal images
    if a ``temperature_bounds.json`` is there, or if none of its images has colour channels.

    Raises:
        SceneError: the reconstruction is damaged, names no image, or names one that is missing.
    """
    notes = ReadingNotes()
    finder = ImageFinder(root)
    file = model.file("images")
    registered = read_images(model)
    if not registered:
        raise scene_error(
            file, "holds no registered image; run COLMAP again with more overlap between the photos"
        )
    images = _image_folders(root, finder, notes)
    found = _match(registered, images, file)
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
    images = []
    for modality, names in FOLDERS.items():
        name = next((name for name in names if (root / name).is_dir()), "")
        if name and (files := finder.tree(root / name)):
            images.append(_Images(modality, name, files))
    if [each.modality for each in images] != [RGB]:
        return images
    has_bounds = any(is_file(root / bounds) for bounds in BOUNDS_FILES)
    if has_bounds or all(probe(path).kind != "colour" for path in images[0].files.values()):
        notes.decide(f"The images in {images[0].folder}/ are taken for thermal ones.")
        return [replace(images[0], modality=THERMAL)]
    return images


def _match(
    registered: Sequence[RegisteredImage], images: Sequence[_Images], file: Path
) -> Registered:
    """The image files of the registered images.

    A name that starts with a folder is looked up there first, else among the RGB images first.
    """
    found: Registered = {}
    for image in registered:
        folder = PurePosixPath(image.name).parts[:1]
        for each in sorted(images, key=lambda each: (each.folder,) != folder):
            key = each.key_of(image.name)
            if key is not None:
                found[each.modality, key] = image
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
