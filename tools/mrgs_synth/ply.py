"""Binary PLY files: meshes for the path tracer and the sparse points of a scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from mrgs_synth.shapes import Mesh


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write a triangle mesh with normals and texture coordinates."""
    vertices = np.concatenate([mesh.vertices, mesh.normals, mesh.uv], axis=1).astype("<f4")
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"] = 3
    faces["corners"] = mesh.faces
    header = _element(
        "vertex",
        len(vertices),
        [f"float {name}" for name in ("x", "y", "z", "nx", "ny", "nz", "u", "v")],
    )
    header += _element("face", len(faces), ["list uchar int vertex_indices"])
    path.write_bytes(_header(header) + vertices.tobytes() + faces.tobytes())


def write_points(
    path: Path, positions: Float[np.ndarray, "n 3"], colors: UInt8[np.ndarray, "n 3"]
) -> None:
    """Write coloured points."""
    rows = np.empty(len(positions), dtype=[("position", "<f4", 3), ("color", "u1", 3)])
    rows["position"] = positions
    rows["color"] = colors
    properties = [f"float {name}" for name in "xyz"] + [
        f"uchar {name}" for name in ("red", "green", "blue")
    ]
    path.write_bytes(_header(_element("vertex", len(rows), properties)) + rows.tobytes())


def _element(name: str, count: int, properties: list[str]) -> list[str]:
    return [f"element {name} {count}", *(f"property {line}" for line in properties)]


def _header(elements: list[str]) -> bytes:
    return (
        "\n".join(["ply", "format binary_little_endian 1.0", *elements, "end_header"]) + "\n"
    ).encode("ascii")
