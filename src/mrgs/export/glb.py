"""glTF binary files with the extension KHR_gaussian_splatting, as the Khronos Group ratified it.

Splats are a primitive of points: scales are linear, opacities in [0, 1], rotations unit quaternions
xyzw, colours the coefficients of 3DGS's spherical harmonics in display-referred sRGB. A reader
without the extension shows the points.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mrgs.export.job import ExportJob, described
from mrgs.export.ply import SMALLEST_SCALE
from mrgs.export.splats import SplatArrays, base_values, to_bytes, value_names
from mrgs.scene import RGB
from mrgs.system.atomic import replacing

EXTENSION = "KHR_gaussian_splatting"

_FLOAT, _UNSIGNED_BYTE = 5126, 5121
_ARRAY_BUFFER = 34962
_POINTS = 0
_MAGIC, _JSON_CHUNK, _BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942


def export(job: ExportJob) -> list[Path]:
    """Write a file for each modality, with its sidecar; each has the temperatures and the values
    of modalities other than RGB."""
    model = job.splat_model
    properties = {
        name: values
        for modality in model.modalities
        if modality != RGB
        for name, values in zip(
            value_names(model, modality), base_values(model, modality).T, strict=True
        )
    }
    paths = []
    for modality, splats, facts in job.splats():
        if job.up is not None:
            facts["frame"] += "; the node turns its up direction to +y"
        path = job.folder / f"{modality}.glb"
        paths += described(write_glb(path, splats, job.up, facts, properties), facts)
    return paths


def write_glb(
    path: Path,
    splats: SplatArrays,
    up: Float[np.ndarray, "3"] | None = None,
    extras: Mapping[str, Any] | None = None,
    properties: Mapping[str, Float[np.ndarray, " n"]] | None = None,
) -> Path:
    """Write a glb file; returns the path. RunError if it cannot be written.

    The node is rotated so that the ``up`` direction of the scene's frame, unit length, becomes
    glTF's +y; None leaves it. ``extras`` are facts for the file's ``asset.extras``, ``properties``
    more numbers per splat by name, float32, which glTF keeps under ``_NAME`` in capitals."""
    attributes = _attributes(splats)
    attributes |= {
        f"_{name.upper()}": values.astype(np.float32) for name, values in (properties or {}).items()
    }
    text = json.dumps(_document(attributes, up, extras or {}), allow_nan=False).encode("utf-8")
    text += b" " * (-len(text) % 4)
    binary = sum(array.nbytes for array in attributes.values())
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(struct.pack("<III", _MAGIC, 2, 12 + 8 + len(text) + 8 + binary))
        file.write(struct.pack("<II", len(text), _JSON_CHUNK) + text)
        file.write(struct.pack("<II", binary, _BINARY_CHUNK))
        for array in attributes.values():
            file.write(np.ascontiguousarray(array).data)
    return path


def _attributes(splats: SplatArrays) -> dict[str, np.ndarray]:
    """The vertex attributes by semantic; each takes a multiple of four bytes."""
    shown = splats.base_colors / np.float32(255)
    # Linear light: what COLOR_0 means where a reader falls back to plain points.
    colors = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    attributes = {
        "POSITION": splats.means,
        "COLOR_0": to_bytes(
            np.concatenate([colors.astype(np.float32), splats.opacities[:, None]], axis=1)
        ),
        f"{EXTENSION}:ROTATION": np.roll(splats.quats, -1, axis=1),
        f"{EXTENSION}:SCALE": splats.scales.clip(SMALLEST_SCALE),
        f"{EXTENSION}:OPACITY": splats.opacities.clip(0, 1),
    }
    for degree in range(splats.sh_degree + 1):
        for index in range(2 * degree + 1):
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{index}"] = splats.sh[
                :, degree**2 + index
            ]
    return attributes


def _document(
    attributes: Mapping[str, np.ndarray],
    up: Float[np.ndarray, "3"] | None,
    extras: Mapping[str, Any],
) -> dict[str, Any]:
    accessors, views, offset = [], [], 0
    for index, (semantic, array) in enumerate(attributes.items()):
        views.append(
            {"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": _ARRAY_BUFFER}
        )
        accessors.append(_accessor(index, semantic, array))
        offset += array.nbytes
    properties = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    properties |= {"projection": "perspective", "sortingMethod": "cameraDistance"}
    primitive = {
        "mode": _POINTS,
        "attributes": {semantic: index for index, semantic in enumerate(attributes)},
        "extensions": {EXTENSION: properties},
    }
    node: dict[str, Any] = {"name": "splats", "mesh": 0}
    if up is not None:
        node["rotation"] = rotation_to_y(up)
    return {
        "asset": {"version": "2.0", "generator": "mrgs", "extras": dict(extras)},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"name": "splats", "primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }


def _accessor(index: int, semantic: str, array: np.ndarray) -> dict[str, Any]:
    channels = array.shape[1] if array.ndim == 2 else 1
    accessor: dict[str, Any] = {
        "bufferView": index,
        "componentType": _FLOAT if array.dtype.kind == "f" else _UNSIGNED_BYTE,
        "count": len(array),
        "type": "SCALAR" if channels == 1 else f"VEC{channels}",
    }
    if array.dtype.kind != "f":
        accessor["normalized"] = True
    if semantic == "POSITION":
        accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
    return accessor


def rotation_to_y(up: Float[np.ndarray, "3"]) -> list[float]:
    """The shortest rotation that turns a unit vector into +y, as a unit quaternion xyzw."""
    rotation, _ = Rotation.align_vectors([[0.0, 1.0, 0.0]], [up])
    return rotation.as_quat().tolist()
