"""Writer of a scene's ``transforms.json`` (nerfstudio) and ``temperature_bounds.json``
(ThermoScenes); ``mrgs.data.nerfstudio`` reads them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from jaxtyping import Float64
from torch import Tensor

from mrgs.scene import Camera, Modality, WorldFrame
from mrgs.scene.lens import Lens
from mrgs.scene.modality import BUILT_IN
from mrgs.scene.rotations import opengl_camera_to_world
from mrgs.system.atomic import write_text

TRANSFORMS, POINTS, BOUNDS = "transforms.json", "sparse_pc.ply", "temperature_bounds.json"

BOUNDS_FILES = (BOUNDS, f"thermal/{BOUNDS}")
"""Possible places of the bounds in a scene's folder; the first that exists is read."""

RECORD = "record"
"""``thermal_record`` of a frame is what the thermal camera noted beside the photo."""

EMPTY: Mapping[Any, Any] = MappingProxyType({})


def frame_json(
    viewmat: Float64[Tensor, "4 4"],
    file_path: str | None,
    others: Mapping[Modality, str] = EMPTY,
    *,
    lens: Lens | None = None,
    viewmats: Mapping[Modality, Float64[Tensor, "4 4"]] = EMPTY,
    lenses: Mapping[Modality, Lens] = EMPTY,
) -> dict[str, Any]:
    """One entry of ``frames``.

    Args:
        file_path: image of this pose; None if there are only ``others``.
        lens: intrinsics of this frame alone; None if all frames share them.
        viewmats: poses of other modalities that are not ``viewmat``.
        lenses: intrinsics of other modalities' images of this frame alone.
    """
    frame: dict[str, Any] = {} if lens is None else lens_json(lens)
    if file_path is not None:
        frame["file_path"] = file_path
    frame |= {f"{modality}_file_path": path for modality, path in others.items()}
    frame["transform_matrix"] = opengl_camera_to_world(viewmat).tolist()
    frame |= {
        f"{modality}_transform_matrix": opengl_camera_to_world(own).tolist()
        for modality, own in viewmats.items()
    }
    return frame | {f"{modality}_camera": lens_json(own) for modality, own in lenses.items()}


def write_transforms(
    path: Path,
    frames: Sequence[Mapping[str, Any]],
    *,
    lens: Lens | None = None,
    lenses: Mapping[Modality, Lens] = EMPTY,
    points: str | None = None,
    split: tuple[Sequence[str], Sequence[str]] | None = None,
    modalities: Iterable[Modality] = (),
    facts: Mapping[str, Any] | None = None,
) -> Path:
    """Write ``transforms.json``; returns the path. RunError if the file cannot be written.

    Args:
        lenses: intrinsics that all images of a modality share, if they differ from ``lens``.
        points: path of the start points, relative to the file.
        split: paths of the training and of the evaluation images; None leaves it to the reader.
        modalities: of the images; all but RGB and thermal are listed in the file.
    """
    content: dict[str, Any] = {**(facts or {}), **({} if lens is None else lens_json(lens))}
    content |= {f"{modality}_camera": lens_json(own) for modality, own in lenses.items()}
    if listed := [each.to_json() for each in modalities if each not in BUILT_IN]:
        content["modalities"] = listed
    if points is not None:
        content["ply_file_path"] = points
    if split is not None:
        train, evaluation = split
        content |= {
            "train_filenames": list(train),
            "val_filenames": list(evaluation),
            "test_filenames": list(evaluation),
        }
    return _write_json(path, {**content, "frames": list(frames)})


def world_json(world: WorldFrame) -> dict[str, Any]:
    """The entry of ``transforms.json`` about the frame of the poses; its origin only if known."""
    facts: dict[str, Any] = {
        "units": "metres" if world.metric else "arbitrary",
        "axes": "east north up" if world.north else "arbitrary",
    }
    if world.origin is not None:
        facts["origin"] = world.origin._asdict()
    names = ("residual_m", "scale_error", "offset", "control_m")
    known = {name: value for name in names if (value := getattr(world, name)) is not None}
    return {"georeference": facts | known}


def write_bounds(path: Path, min_c: float, max_c: float) -> Path:
    """Write ``temperature_bounds.json``: the °C of black and white; returns the path. RunError if
    the file cannot be written."""
    bounds = {"absolute_min_temperature": min_c, "absolute_max_temperature": max_c}
    return _write_json(path, bounds)


def lens_json(lens: Lens) -> dict[str, Any]:
    """A lens in nerfstudio's keys."""
    numbers: dict[str, Any] = {
        "camera_model": "OPENCV_FISHEYE" if lens.fisheye else "OPENCV",
        "w": lens.width,
        "h": lens.height,
        "fl_x": lens.fx,
        "fl_y": lens.fy,
        "cx": lens.cx,
        "cy": lens.cy,
        **{f"k{number}": value for number, value in enumerate(lens.radial, 1)},
    }
    if not lens.fisheye:
        numbers |= {"p1": lens.tangential[0], "p2": lens.tangential[1]}
    return numbers


def pinhole_lens(camera: Camera) -> Lens:
    """The intrinsics of a camera without distortion."""
    fx, fy, cx, cy = (float(camera.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Lens(camera.width, camera.height, fx, fy, cx, cy)


def _write_json(path: Path, content: Mapping[str, Any]) -> Path:
    return write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")
