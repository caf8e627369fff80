"""Scenes described by nerfstudio's ``transforms.json``: ThermoScenes, plain nerfstudio, and rigs of
two cameras.

Beyond nerfstudio's own keys a frame may have ``thermal_file_path`` and ``thermal_mask_path``; a
thermal camera of its own is given by ``thermal_camera`` (intrinsics, at the top or in the frame)
and ``thermal_transform_matrix``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from torch import Tensor

from mrgs.data.capture import Capture, FilenameLists, ImageSource, Notes, Shot
from mrgs.data.colmap_model import find_model, read_points3d
from mrgs.data.files import (
    ImageFinder,
    contained,
    finite_number,
    is_file,
    read_json_object,
    scene_error,
    shown,
    without_image_suffix,
)
from mrgs.data.images import probe
from mrgs.data.lens import Lens, checked_lens
from mrgs.data.ply import read_ply
from mrgs.data.points import point_cloud
from mrgs.data.poses import matrix_from_json, viewmat_from_opengl
from mrgs.scene import PointCloud

_PERSPECTIVE_MODELS = {
    "OPENCV",
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "PERSPECTIVE",
}
_FISHEYE_MODELS = {"OPENCV_FISHEYE"}
_LEGACY_APPLIED_TRANSFORM = np.array(
    [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]
)
"""What nerfstudio applied to COLMAP's world before it wrote ``applied_transform`` into the file."""


def find_transforms(root: Path) -> Path | None:
    """The scene's ``transforms.json``, or else ``transforms_thermal.json``, or else the only
    ``transforms*.json``."""
    for name in ("transforms.json", "transforms_thermal.json"):
        if is_file(root / name):
            return contained(root, name, root)
    others = sorted(root.glob("transforms*.json"))
    if len(others) > 1:
        names = ", ".join(path.name for path in others)
        raise scene_error(
            root, f"has several transforms files ({names}); join them into one transforms.json"
        )
    return contained(root, others[0].name, root) if others else None


def read_transforms(root: Path, file: Path) -> Capture:
    """Understand a nerfstudio scene; images are looked up, not decoded.

    Args:
        root: the scene's folder, resolved; all paths in the file are relative to it.
        file: the transforms file.

    Raises:
        SceneError: the file is damaged, or an image that it names is missing.
    """
    return _Reader(root, file).capture()


def lens_from_json(
    values: Mapping[str, Any], what: str, file: Path, image: Path | None = None
) -> Lens:
    """A lens in nerfstudio's keys: ``camera_model``, ``w``, ``h``, ``fl_x``, ``cx``, ``k1`` and so
    on.

    Args:
        values: the JSON object.
        what: whose lens it is, for messages.
        file: the JSON file, for messages.
        image: has the size that ``values`` may leave out.

    Raises:
        SceneError: a number is missing or cannot be, or the model is not known.
    """

    def number(name: str, default: float | None = None) -> float:
        if values.get(name) is None and default is not None:
            return default
        return finite_number(values.get(name), f"{name} of {what}", file)

    model = values.get("camera_model", "OPENCV")
    if not isinstance(model, str) or model not in _PERSPECTIVE_MODELS | _FISHEYE_MODELS:
        known = ", ".join(sorted(_PERSPECTIVE_MODELS | _FISHEYE_MODELS))
        raise scene_error(
            file, f"camera_model is {shown(model)}; undistort the images, or use one of {known}"
        )
    info = probe(image) if image and (values.get("w") is None or values.get("h") is None) else None
    width = number("w", float(info.width) if info else None)
    height = number("h", float(info.height) if info else None)
    if width % 1 or height % 1:
        raise scene_error(
            file, f"the image size of {what}, {width}×{height}, is not whole; correct w and h"
        )
    focal = number("fl_x")
    lens = Lens(
        width=int(width),
        height=int(height),
        fx=focal,
        fy=number("fl_y", focal),
        cx=number("cx", width / 2),
        cy=number("cy", height / 2),
        radial=(number("k1", 0.0), number("k2", 0.0), number("k3", 0.0), number("k4", 0.0)),
        tangential=(0.0, 0.0)
        if model in _FISHEYE_MODELS
        else (number("p1", 0.0), number("p2", 0.0)),
        fisheye=model in _FISHEYE_MODELS,
    )
    return checked_lens(lens, what, file)


class _Reader:
    """Holds what every step needs: the folder, the file's content and the notes."""

    def __init__(self, root: Path, file: Path) -> None:
        self.root = root
        self.file = file
        self.top = read_json_object(file)
        self.images = ImageFinder(root)
        self.notes = Notes()

    def capture(self) -> Capture:
        frames = self.top.get("frames")
        if not isinstance(frames, list) or not frames:
            raise scene_error(
                self.file,
                f'"frames" is {shown(frames)}, not a list of frames; export the file again',
            )
        shots = [self._shot(frame, f"frame {index}") for index, frame in enumerate(frames)]
        if 0 < (alone := sum(shot.thermal is None for shot in shots)) < len(shots):
            self.notes.decide(f"{alone} of {len(shots)} frames have no thermal image.")
        return Capture(self.root, self.file, shots, self._points(), self.notes, self._lists())

    def _shot(self, frame: object, what: str) -> Shot:
        if not isinstance(frame, dict):
            raise scene_error(
                self.file, f"{what} is {shown(frame)}, not an object; export the file again"
            )
        rgb_path, thermal_path = self._image_paths(frame, what)
        key_path = rgb_path or thermal_path
        if key_path is None:
            raise scene_error(self.file, f"{what} has no file_path; add it or remove the frame")
        what = f"{what} ({shown(self._key_of(key_path))})"
        viewmat = self._viewmat(frame, "transform_matrix", what)
        rgb = thermal = None
        if rgb_path:
            lens = self._lens(frame, rgb_path, what)
            rgb = ImageSource(
                rgb_path, lens, viewmat, self._mask(frame, "mask_path", "masks", rgb_path, what)
            )
        if thermal_path:
            own = frame.get("thermal_camera", self.top.get("thermal_camera"))
            if own is not None and not isinstance(own, dict):
                raise scene_error(
                    self.file, f"thermal_camera is {shown(own)}, not an object; correct it"
                )
            if "thermal_transform_matrix" in frame:
                viewmat = self._viewmat(frame, "thermal_transform_matrix", what)
            lens = self._lens(frame if own is None else own, thermal_path, what, shared=own is None)
            mask = self._mask(frame, "thermal_mask_path", "thermal_masks", thermal_path, what)
            thermal = ImageSource(thermal_path, lens, viewmat, mask)
        return Shot(self._key_of(key_path), rgb, thermal)

    def _key_of(self, path: Path) -> str:
        return without_image_suffix(path.relative_to(self.root).as_posix())

    def _image_paths(self, frame: Mapping[str, Any], what: str) -> tuple[Path | None, Path | None]:
        """The RGB and the thermal image of a frame. A ``file_path`` in a folder ``thermal`` is a
        thermal image."""
        rgb = self._path(frame, "file_path", what)
        thermal = self._path(frame, "thermal_file_path", what)
        if thermal is None and rgb is not None:
            if rgb.parent.name == "thermal":
                return None, rgb
            thermal = self.images.find(f"thermal/{rgb.name}", self.file)
        return rgb, thermal

    def _path(self, frame: Mapping[str, Any], name: str, what: str) -> Path | None:
        value = frame.get(name)
        if value is None:
            return None
        if not isinstance(value, str) or not value:
            raise scene_error(
                self.file, f"{name} of {what} is {shown(value)}, not a path; correct it"
            )
        path = self.images.find(value, self.file)
        if path is None:
            raise scene_error(
                self.file,
                f"the image {shown(value)} of {what} is missing; restore it or remove the frame",
            )
        return path

    def _mask(
        self, frame: Mapping[str, Any], name: str, folder: str, image: Path, what: str
    ) -> Path | None:
        return self._path(frame, name, what) or self.images.find_mask(folder, image.name, self.file)

    def _viewmat(self, frame: Mapping[str, Any], name: str, what: str) -> Float64[Tensor, "4 4"]:
        label = f"{name} of {what}"
        return viewmat_from_opengl(
            matrix_from_json(frame.get(name), (3, 4), label, self.file), label, self.file
        )

    def _lens(self, own: Mapping[str, Any], image: Path, what: str, shared: bool = True) -> Lens:
        """The lens of an image; ``own`` wins, and what it lacks comes from the top level if the
        lens is shared."""
        return lens_from_json({**self.top, **own} if shared else own, what, self.file, image)

    def _lists(self) -> FilenameLists:
        def keys(name: str) -> frozenset[str] | None:
            names = self.top.get(name)
            if names is None:
                return None
            if not isinstance(names, list) or not all(isinstance(item, str) for item in names):
                raise scene_error(
                    self.file, f"{name} is {shown(names)}, not a list of paths; correct it"
                )
            return frozenset(without_image_suffix(PurePosixPath(item).as_posix()) for item in names)

        held_out = [
            listed
            for name in ("val_filenames", "test_filenames")
            if (listed := keys(name)) is not None
        ]
        return FilenameLists(
            keys("train_filenames"), frozenset().union(*held_out) if held_out else None
        )

    def _points(self) -> PointCloud | None:
        """Start points. Like nerfstudio: a PLY is in the frames' world but for ``applied_scale``,
        COLMAP's points are moved by ``applied_transform`` first.
        """
        scale = finite_number(self.top.get("applied_scale", 1.0), "applied_scale", self.file)
        scaling = np.eye(3, 4) * scale
        named = self.top.get("ply_file_path")
        if named is not None and not isinstance(named, str):
            raise scene_error(self.file, f"ply_file_path is {shown(named)}, not a path; correct it")
        ply = contained(self.root, named or "sparse_pc.ply", self.file)
        if named or is_file(ply):
            return point_cloud(*read_ply(ply), self.notes, scaling)
        model = find_model(self.root)
        if model is None:
            return None
        return point_cloud(*read_points3d(model), self.notes, scale * self._applied_transform())

    def _applied_transform(self) -> NDArray[np.float64]:
        value = self.top.get("applied_transform")
        if value is None:
            self.notes.decide(
                "There is no applied_transform: COLMAP's points are turned as nerfstudio used to."
            )
            return _LEGACY_APPLIED_TRANSFORM
        return matrix_from_json(value, (3, 4), "applied_transform", self.file)[:3]
