"""Scenes described by nerfstudio's ``transforms.json``: ThermoScenes, plain nerfstudio, and rigs of
two cameras.

Beyond nerfstudio's own keys a frame may have ``thermal_file_path`` and ``thermal_mask_path``; a
thermal camera of its own is given by ``thermal_camera`` (intrinsics, at the top or in the frame)
and ``thermal_transform_matrix``. The same keys exist for every modality that the file lists under
``modalities`` (``[{"name": "nir", "channels": 1}]``; ``unit`` and ``title`` may be added), and for
those that Python has registered. With ``is_thermal`` (0 or 1), as in ThermalNeRF's scenes, each
camera's images are frames of their own. A file for each split, as in NeRF's synthetic scenes, is
read as one scene.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, TypeAlias

import msgspec
import numpy as np

from mrgs.data.cameras import lens_from_json, matrix_from_json, viewmat_from_opengl
from mrgs.data.colmap import FOLDERS, find_model, read_points3d
from mrgs.data.files import (
    MAX_MAGNITUDE,
    ImageFinder,
    Number,
    composed,
    contained,
    is_file,
    read_json_object,
    without_image_suffix,
)
from mrgs.data.ply import read_ply
from mrgs.data.sources import (
    FilenameLists,
    ImageSource,
    ReadingNotes,
    SceneSource,
    ViewSource,
    point_cloud,
)
from mrgs.data.transforms import RECORD
from mrgs.errors import scene_error
from mrgs.scene import (
    RGB,
    THERMAL,
    EarthPosition,
    Modality,
    PointCloud,
    WorldFrame,
    known_modalities,
)
from mrgs.scene.lens import Lens
from mrgs.scene.radiometry import PhotoRecord
from mrgs.system.typed_json import from_json, json_value
from mrgs.system.wording import shown

_NotNegative: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=MAX_MAGNITUDE)]
_Offset: TypeAlias = Annotated[float, msgspec.Meta(ge=-1e8, le=1e8)]

MOST_MODALITIES = 16
IMAGE_CHANNELS = (1, 3)
"""Supported numbers of channels in image files."""
_TAKEN = re.compile(
    r"images|.*masks|sparse|truth|train|val|test|eval|temperature_c|thermal_normalised|depth_.*"
)
"""Names of other folders, in scenes and among renderings, that a modality must not have."""
_LENS_KEYS = (
    "camera_model", "w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2",
    "is_fisheye", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov",
)  # fmt: skip
_REFUSED = (
    "k5", "k6", "ftheta_p0", "ftheta_p1", "ftheta_p2", "latlong", "equirectangular",
    "orthographic", "rolling_shutter", "transform_matrix_start", "from_na", "distortion_params",
)  # fmt: skip
"""Keys of nerfstudio, instant-ngp and others that change what the rest means, and are not read."""
_SPLIT_FILES = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
"""Files of one split each; the last two are held out."""
_HELD_OUT = "mrgs_held_out"
_LEGACY_APPLIED_TRANSFORM = np.array(
    [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]
)
"""Transform of COLMAP's world by versions of nerfstudio that wrote no ``applied_transform``."""


def find_transforms(root: Path) -> Path | None:
    """The scene's ``transforms.json``, or ``transforms_thermal.json``, or the only other one, or
    ``transforms_train.json`` of one file for each split."""
    for name in ("transforms.json", "transforms_thermal.json"):
        if is_file(root / name):
            return contained(root, name, root)
    names = sorted(path.name for path in root.glob("transforms*.json"))
    if _SPLIT_FILES[0] in names and set(names) <= set(_SPLIT_FILES):
        names = [_SPLIT_FILES[0]]
    if len(names) > 1:
        listed = ", ".join(names)
        raise scene_error(
            root, f"has several transforms files ({listed}); join them into one transforms.json"
        )
    return contained(root, names[0], root) if names else None


def read_transforms(root: Path, file: Path) -> SceneSource:
    """Read a nerfstudio scene; images are looked up, not decoded. SceneError if the file is
    damaged, or an image that it names is missing. ``root`` is the scene's folder, resolved; all
    paths in the file are relative to it."""
    return _TransformsReader(root, file).capture()


@dataclass(frozen=True)
class _Origin:
    latitude_deg: Annotated[float, msgspec.Meta(ge=-90, le=90)]
    longitude_deg: Annotated[float, msgspec.Meta(ge=-180, le=180)]
    altitude_m: Annotated[float, msgspec.Meta(ge=-MAX_MAGNITUDE, le=MAX_MAGNITUDE)] | None = None


@dataclass(frozen=True)
class _Georeference:
    """The entry ``georeference`` of the file."""

    units: str = ""
    axes: str = ""
    origin: _Origin | None = None
    residual_m: _NotNegative | None = None
    scale_error: _NotNegative | None = None
    offset: tuple[_Offset, _Offset, _Offset] | None = None
    control_m: _NotNegative | None = None


def _of_lens(values: Mapping[str, Any]) -> dict[str, Any]:
    """The entries that describe a lens; lists of zeros among ``_REFUSED`` are 0."""
    found = {name: values[name] for name in (*_REFUSED, *_LENS_KEYS) if name in values}
    is_zero = {n for n in _REFUSED if isinstance(found.get(n), list) and not any(found[n])}
    return found | dict.fromkeys(is_zero, 0)


def _folders(modality: Modality) -> tuple[str, ...]:
    """How folders with images of a modality may be named."""
    own = modality.name, f"images_{modality}", f"{modality}_images"
    return *own, *FOLDERS.get(modality, ())


def _content(root: Path, file: Path) -> dict[str, Any]:
    """The file's JSON; that of the training split with the frames of the other splits' files, each
    with its own file's lens, which are held out."""
    content = read_json_object(file)
    if file.name != _SPLIT_FILES[0]:
        return content
    frames = json_value(list[dict[str, Any]], content.get("frames"), '"frames"', file)
    known = {json.dumps(frame.get("file_path")): at for at, frame in enumerate(frames)}
    for name in filter(lambda name: is_file(root / name), _SPLIT_FILES[1:]):
        other = read_json_object(contained(root, name, root))
        cameras = {key: value for key, value in other.items() if key.endswith("_camera")}
        own = json_value(list[dict[str, Any]], other.get("frames"), '"frames"', root / name)
        for frame in own:
            at = known.setdefault(json.dumps(frame.get("file_path")), len(frames))
            held_out = {**_of_lens(other), **cameras, **frame, _HELD_OUT: True}
            if at == len(frames):
                frames.append(held_out)
            elif name == _SPLIT_FILES[2]:  # a validation split may be that of the training
                frames[at] = held_out
    content["frames"] = frames
    return content


class _TransformsReader:
    """Holds what every step needs: the folder, the file's content and the notes."""

    def __init__(self, root: Path, file: Path) -> None:
        self.root = root
        self.file = file
        self.top = _content(root, file)
        self.images = ImageFinder(root)
        self.notes = ReadingNotes()
        self.modalities = self._modalities()
        self._top_lens = _of_lens(self.top)
        self._lenses: dict[str, Lens] = {}
        self._held_out: list[str] = []

    def _modalities(self) -> tuple[Modality, ...]:
        """Modalities of the frames: the known ones, and those that the file lists."""
        some = Annotated[list[Any], msgspec.Meta(max_length=MOST_MODALITIES)]
        listed = json_value(some, self.top.get("modalities", []), "modalities", self.file)
        by_name = {modality.name: modality for modality in known_modalities()}
        for value in listed:
            try:
                modality = Modality.from_json(value)
            except ValueError as error:
                raise scene_error(self.file, f"modalities: {error}; correct it") from None
            if modality.channels not in IMAGE_CHANNELS:
                raise scene_error(
                    self.file,
                    f"modality {modality} has {shown(modality.channels)} channels; images that can "
                    f"be read have 1 or 3",
                )
            if _TAKEN.fullmatch(modality.name):
                raise scene_error(
                    self.file, f"a folder named {modality} has another meaning; rename the modality"
                )
            if by_name.setdefault(modality.name, modality) != modality:
                raise scene_error(
                    self.file,
                    f"modality {modality} has {modality.channels} channels here and "
                    f"{by_name[modality.name].channels} elsewhere; correct it",
                )
        return tuple(by_name.values())

    def capture(self) -> SceneSource:
        some = Annotated[list[Any], msgspec.Meta(min_length=1)]
        remedy = "export the file again"
        frames = json_value(some, self.top.get("frames"), '"frames"', self.file, remedy)
        named = (frame.get("file_path") for frame in frames if isinstance(frame, dict))
        found = (self.images.find(name, self.file) for name in named if isinstance(name, str))
        self._own = {*found}  # images that are frames of their own
        views = [self._view(frame, f"frame {index}") for index, frame in enumerate(frames)]
        for modality in self.modalities:
            missing = sum(modality not in view.images for view in views)
            if modality != RGB and 0 < missing < len(views):
                self.notes.decide(f"{missing} of {len(views)} frames have no {modality} image.")
        lists, world = self._lists(views), self._world()
        return SceneSource(self.root, self.file, views, self._points(), self.notes, lists, world)

    def _view(self, value: object, what: str) -> ViewSource:
        remedy = "export the file again"
        frame: dict[str, Any] = json_value(dict[str, Any], value, what, self.file, remedy)
        paths = self._image_paths(frame, what)
        if not paths:
            raise scene_error(self.file, f"{what} has no file_path; add it or remove the frame")
        first = next(iter(paths.values()))
        key = without_image_suffix(composed(first.relative_to(self.root).as_posix()))
        what = f"{what} ({shown(key)})"
        if _HELD_OUT in frame:
            self._held_out.append(key)
        images = {
            modality: self._source(modality, frame, path, what) for modality, path in paths.items()
        }
        return ViewSource(key, images)

    def _source(
        self, modality: Modality, frame: Mapping[str, Any], path: Path, what: str
    ) -> ImageSource:
        """An image with its camera: the frame's, unless its modality has one of its own."""
        prefix = "" if modality == RGB else f"{modality}_"
        camera = f"{prefix}camera"
        own = frame.get(camera, self.top.get(camera)) if prefix else None
        if not isinstance(own, dict):  # of a large one, a copy for each frame would take long
            own = json_value(dict[str, Any] | None, own, camera, self.file)
        lens = self._lens(frame if own is None else own, path, what, shared=own is None)
        pose = f"{prefix}transform_matrix"
        name = pose if pose in frame else "transform_matrix"
        label = f"{name} of {what}"
        matrix = matrix_from_json(frame.get(name), label, self.file)
        viewmat = viewmat_from_opengl(matrix, label, self.file)
        mask = self._path(frame, f"{prefix}mask_path", what) or self.images.find_mask(
            f"{prefix}masks", path.name, self.file
        )
        name, record = f"{modality}_{RECORD}", None
        if name in frame:  # what the camera noted beside the photo, as ``prepare`` writes it
            try:
                record = PhotoRecord.from_json(frame[name])
            except ValueError as error:
                raise scene_error(
                    self.file, f"{name} of {what}: {error}; prepare the scene again, or remove it"
                ) from None
        return ImageSource(path, lens, viewmat, mask, record)

    def _image_paths(self, frame: Mapping[str, Any], what: str) -> dict[Modality, Path]:
        """The images of a frame by modality, RGB first. A ``file_path`` in a folder named like
        another modality is of that one; an image that is not named is looked for in the folder of
        its modality, under the name of the first, with or without that one's own folder. A frame
        that says whether it ``is_thermal``, as ThermalNeRF's do, has one image."""
        first = self._path(frame, "file_path", what)
        others = [modality for modality in self.modalities if modality != RGB]
        paths = {
            modality: path
            for modality in others
            if (path := self._path(frame, f"{modality}_file_path", what))
        }
        if first is None:
            return paths
        flag = frame.get("is_thermal")
        json_value(bool | float | None, flag, f"is_thermal of {what}", self.file)
        if not paths and flag is not None:
            return {THERMAL if flag else RGB: first}
        for modality in others:
            if modality not in paths and first.parent.name.casefold() in _folders(modality):
                return {modality: first, **paths}
        found = {RGB: first, **paths}
        for modality in (each for each in others if each not in found):
            names = f"{first.parent.name}/{first.name}", first.name
            named = (f"{folder}/{name}" for name in names for folder in _folders(modality))
            tried = (self.images.find(name, self.file) for name in named)
            path = next(filter(None, tried), None)
            if path is not None and path not in self._own:
                found[modality] = path
        return {modality: found[modality] for modality in self.modalities if modality in found}

    def _path(self, frame: Mapping[str, Any], name: str, what: str) -> Path | None:
        value = json_value(str | None, frame.get(name), f"{name} of {what}", self.file)
        if value is None:
            return None
        path = self.images.find(value, self.file)
        if path is None:
            raise scene_error(
                self.file,
                f"the image {shown(value)} of {what} is missing; restore it or remove the frame",
            )
        return path

    def _lens(self, own: Mapping[str, Any], image: Path, what: str, shared: bool = True) -> Lens:
        """The lens of an image; ``own`` wins, and what it lacks comes from the top level if the
        lens is shared. What many images share is read once."""
        values = {**self._top_lens, **_of_lens(own)} if shared else _of_lens(own)
        if changing := next((name for name in _REFUSED if values.pop(name, None)), None):
            raise scene_error(
                self.file,
                f"{changing} of {what} is not read, and changes what the other keys mean; "
                f"undistort the images, and remove it",
            )
        if values.get("w") is None or values.get("h") is None:  # each image has a size of its own
            lens = lens_from_json(values, what, self.file, image)
            if shared and values.get("fl_x") is not None:
                first = self._lenses.setdefault(repr(values), lens)
                if {first.width, first.height} != {lens.width, lens.height}:  # or on its side
                    size = f"{lens.width}×{lens.height} px, others {first.width}×{first.height}"
                    raise scene_error(
                        self.file, f"{what} has {size}, with the same fl_x; add w and h to each"
                    )
            return lens
        key = repr(values)
        if key not in self._lenses:
            self._lenses[key] = lens_from_json(values, what, self.file)
        return self._lenses[key]

    def _lists(self, views: Sequence[ViewSource]) -> FilenameLists:
        """The lists of images, by the keys of the views; a bare name is that of the only one."""
        keys_of = defaultdict[str, list[str]](list)
        for view in views:
            keys_of[PurePosixPath(view.key).name].append(view.key)

        def key_of(item: str) -> str:
            key = composed(without_image_suffix(PurePosixPath(item.replace("\\", "/")).as_posix()))
            same = keys_of.get(key, [])
            return same[0] if len(same) == 1 else key.removeprefix(f"{self.root.as_posix()}/")

        def keys(name: str) -> frozenset[str] | None:
            names = json_value(list[str] | None, self.top.get(name), name, self.file)
            return None if names is None else frozenset(map(key_of, names))

        if self._held_out:
            return FilenameLists(None, frozenset(self._held_out))
        held_out = [keys("val_filenames"), keys("test_filenames")]
        named = [each for each in held_out if each is not None]
        return FilenameLists(keys("train_filenames"), frozenset().union(*named) if named else None)

    def _points(self) -> PointCloud | None:
        """Start points. Like nerfstudio: a PLY is in the frames' world but for ``applied_scale``,
        COLMAP's points are moved by ``applied_transform`` first.
        """
        scale = json_value(Number, self.top.get("applied_scale", 1.0), "applied_scale", self.file)
        if scale <= 0:
            raise scene_error(
                self.file, f"applied_scale is {scale:g}; it must be positive: correct it"
            )
        scaling = np.eye(3, 4) * scale
        named = json_value(str | None, self.top.get("ply_file_path"), "ply_file_path", self.file)
        ply = contained(self.root, named or "sparse_pc.ply", self.file)
        if named or is_file(ply):
            return point_cloud(*read_ply(ply), self.notes, scaling)
        model = find_model(self.root)
        if model is None:
            return None
        transform, value = _LEGACY_APPLIED_TRANSFORM, self.top.get("applied_transform")
        if value is None:
            self.notes.decide(
                "There is no applied_transform: COLMAP's points are turned as nerfstudio used to."
            )
        else:
            transform = matrix_from_json(value, "applied_transform", self.file)[:3]
        return point_cloud(*read_points3d(model), self.notes, scale * transform)

    def _world(self) -> WorldFrame:
        """The frame as ``prepare`` writes it; of other programs' files nothing is known."""
        try:
            facts = from_json(_Georeference, self.top.get("georeference", {}))
        except ValueError as error:
            raise scene_error(
                self.file, f"georeference: {error}; prepare the scene again, or remove it"
            ) from None
        return WorldFrame(
            facts.units == "metres",
            facts.axes == "east north up",
            None if facts.origin is None else EarthPosition(**vars(facts.origin)),
            facts.residual_m,
            facts.scale_error,
            facts.offset,
            facts.control_m,
        )
