"""Lenses and poses that files describe: their checks, and their conversion to OpenCV's axes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import msgspec
import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from torch import Tensor

from mrgs.data.files import MAX_MAGNITUDE, Number
from mrgs.data.images import probe
from mrgs.errors import scene_error
from mrgs.scene.lens import Lens
from mrgs.scene.rotations import (
    OPENGL_FROM_OPENCV,
    ORTHONORMAL_TOLERANCE,
    ends_in_last_row,
    matrix_from_quaternion,
    nearest_rotations,
    rigid_transform,
)
from mrgs.system.typed_json import json_value
from mrgs.system.wording import shown

_MAX_SIDE_PX = 1_000_000
_SHORTEST_PX = 1e-3
"""Shorter focal lengths are damage."""

_FISHEYE = "OPENCV_FISHEYE"
_MODELS = {
    "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE", _FISHEYE
}  # fmt: skip

_Matrix: TypeAlias = Annotated[
    list[tuple[Number, Number, Number, Number]], msgspec.Meta(min_length=3, max_length=4)
]


def lens_from_json(
    values: Mapping[str, Any], what: str, file: Path, image: Path | None = None
) -> Lens:
    """A lens in nerfstudio's keys: ``camera_model``, ``w``, ``h``, ``fl_x``, ``cx``, ``k1`` and so
    on; or in instant-ngp's: ``is_fisheye``, and an angle of view in place of the focal length.
    SceneError if a number is missing or invalid, or the model is not known. ``what`` says whose
    lens it is, for messages; ``image`` has the size that ``values`` may leave out."""

    def number(name: str, default: float | None = None) -> float:
        value = values.get(name)
        found: float = json_value(
            Number, default if value is None else value, f"{name} of {what}", file
        )
        return found

    model = values.get("camera_model", "OPENCV")
    if not isinstance(model, str) or model not in _MODELS:
        known = ", ".join(sorted(_MODELS))
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

    def focal(axis: str, pixels: float) -> float | None:
        """Focal length, px, from ``fl_x``, ``x_fov`` (degrees) or ``camera_angle_x`` (radians)."""
        angle = number(f"camera_angle_{axis}", math.radians(number(f"{axis}_fov", 0.0)))
        if values.get(f"fl_{axis}") is not None:
            return number(f"fl_{axis}")
        return pixels / (2 * math.tan(angle / 2)) if 0 < angle < math.pi else None

    fx, fy = focal("x", width), focal("y", height)
    fx = fy if fx is None else fx
    if fx is None:
        raise scene_error(
            file,
            f"{what} has no focal length; add fl_x (pixels), camera_angle_x (radians, below π) or "
            f"x_fov (degrees)",
        )
    flag = json_value(bool | None, values.get("is_fisheye"), f"is_fisheye of {what}", file)
    fisheye = bool(flag) or model == _FISHEYE
    k1, k2, k3, k4, p1, p2 = (number(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    lens = Lens(
        int(width),
        int(height),
        fx,
        fx if fy is None else fy,
        number("cx", width / 2),
        number("cy", height / 2),
        (k1, k2, k3, k4),
        (0.0, 0.0) if fisheye else (p1, p2),
        fisheye,
    )
    return checked_lens(lens, what, file)


def checked_lens(lens: Lens, what: str, file: Path) -> Lens:
    """The lens itself, if its numbers can be those of a camera. SceneError for sizes or focal
    lengths that are not positive, and numbers that are not finite or huge."""
    numbers = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.radial, *lens.tangential)
    if not all(abs(number) <= MAX_MAGNITUDE for number in numbers):
        raise scene_error(
            file, f"the intrinsics of {what} hold NaN, infinity or a huge number; correct them"
        )
    if not (1 <= lens.width <= _MAX_SIDE_PX and 1 <= lens.height <= _MAX_SIDE_PX):
        fault = f"the image size of {what}, {lens.width}×{lens.height}, is not possible; correct it"
        raise scene_error(file, fault)
    if not min(lens.fx, lens.fy) >= _SHORTEST_PX:
        raise scene_error(
            file,
            f"the focal length of {what} is {lens.fx:g}, {lens.fy:g} px; it must be positive: "
            f"correct it",
        )
    return lens


def matrix_from_json(value: object, what: str, file: Path) -> NDArray[np.float64]:
    """A 3×4 or 4×4 matrix from a JSON value; SceneError for another shape, entries that are not
    numbers, or numbers that are not finite or too large."""
    remedy = "it must be 3×4 or 4×4 finite numbers"
    return np.array(json_value(_Matrix, value, what, file, remedy))


def nearest_rotation(matrix: NDArray[np.float64], what: str, file: Path) -> NDArray[np.float64]:
    """The nearest rotation (by SVD); SceneError unless it is within ``ORTHONORMAL_TOLERANCE``."""
    rotations, is_rotation = nearest_rotations(matrix[None])
    if not is_rotation[0]:
        raise scene_error(
            file,
            f"{what} is not a rotation and a translation (scaled, sheared or mirrored axes); "
            f"correct it",
        )
    return rotations[0]


def viewmat_from_opengl(
    camera_to_world: NDArray[np.float64], what: str, file: Path
) -> Float64[Tensor, "4 4"]:
    """World to camera with OpenCV axes, from nerfstudio's camera to world with OpenGL axes, [3 or
    4, 4]. SceneError if it is not a rigid motion."""
    rotation = nearest_rotation(camera_to_world[:3, :3], what, file)
    if not ends_in_last_row(camera_to_world):
        raise scene_error(file, f"the last row of {what} is not 0 0 0 1; correct it")
    from_world = OPENGL_FROM_OPENCV[:3, :3] @ rotation.T
    return rigid_transform(from_world, -(from_world @ camera_to_world[:3, 3]))


def viewmat_from_colmap(
    qvec: NDArray[np.float64], tvec: NDArray[np.float64], what: str, file: Path
) -> Float64[Tensor, "4 4"]:
    """World to camera from COLMAP's unit quaternion (w, x, y, z) and translation. SceneError for
    numbers that are not finite or huge, and for a quaternion whose length is not 1."""
    if not (np.abs(tvec) <= MAX_MAGNITUDE).all() or not (np.abs(qvec) <= 2).all():
        raise scene_error(
            file, f"the pose of {what} holds NaN, infinity or a huge number; run COLMAP again"
        )
    norm = np.linalg.norm(qvec)
    if abs(norm - 1) > ORTHONORMAL_TOLERANCE:
        raise scene_error(
            file, f"the quaternion of {what} has length {norm:.4g}, not 1; run COLMAP again"
        )
    return rigid_transform(matrix_from_quaternion(qvec), tvec)
