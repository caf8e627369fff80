"""``mesh.ply``: triangles with a colour and a temperature per vertex, from renderings of the
model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.sparse.csgraph
from jaxtyping import Float, Float32, Int32, UInt8

from mrgs.data.ply import write_ply
from mrgs.errors import RunError
from mrgs.export.fusion import fuse
from mrgs.export.job import ExportJob, described
from mrgs.export.rendered import depth_maps, value_columns
from mrgs.export.sidecar import comment_lines
from mrgs.export.surface_nets import surface_nets
from mrgs.runs.baked import BakedModel
from mrgs.scene import Scene
from mrgs.scene.depth_map import carry_over

RESOLUTION = 320
"""Samples along the longest side of the scene."""

SMALLEST_PART = 0.005
"""Connected parts with fewer than this share of the largest part's faces are left out: floating
specks."""


@dataclass(frozen=True, eq=False)
class ThermalMesh:
    """Triangles with a colour and a temperature per vertex.

    Attributes:
        vertices: world coordinates (scene units), [V, 3].
        faces: rows of ``vertices``, counter-clockwise from outside, [F, 3].
        columns: colours, temperatures and other values by their names in files, see
            ``value_columns``, [V] each.
    """

    vertices: Float32[np.ndarray, "v 3"]
    faces: Int32[np.ndarray, "f 3"]
    columns: Mapping[str, Float32[np.ndarray, " v"] | UInt8[np.ndarray, " v"]]


def export(job: ExportJob) -> list[Path]:
    """Write ``mesh.ply`` and its sidecar."""
    path, facts = job.folder / "mesh.ply", job.surface_facts
    mesh = build_mesh(job.baked, job.scene)
    mesh = replace(mesh, columns=job.corrected(mesh.vertices, mesh.columns))
    write_mesh_ply(path, mesh, comment_lines(facts))
    return described(path, {**facts, "vertices": len(mesh.vertices), "faces": len(mesh.faces)})


def build_mesh(baked: BakedModel, scene: Scene, resolution: int = RESOLUTION) -> ThermalMesh:
    """Render the training cameras, fuse their depths, and draw the surface; colours, °C and other
    values are the renderings' means.

    The depth is that of ``depth_maps``.

    Raises:
        RunError: the renderings show no surface.
    """
    maps = depth_maps(baked, scene)
    field, grid = fuse(maps, resolution)
    points, faces = surface_nets(field)
    vertices = (grid.origin + grid.step * points).astype(np.float32)
    values, seen = carry_over(maps, vertices, 2 * grid.step)
    vertices, faces, values = _without_specks(vertices, faces[seen[faces].all(axis=1)], values)
    if not len(faces):
        raise RunError(
            "the depths of the model's views agree nowhere, so there is no mesh: train it longer"
        )
    return ThermalMesh(vertices, faces, value_columns(baked, values))


def write_mesh_ply(path: Path, mesh: ThermalMesh, comments: Sequence[str] = ()) -> Path:
    """Write vertices with colour, ``temperature_c`` (or ``temperature_normalised``) and other
    modalities, and faces; returns the path.

    Raises:
        RunError: the file cannot be written.
    """
    columns: dict[str, np.ndarray] = {axis: mesh.vertices[:, i] for i, axis in enumerate("xyz")}
    columns |= mesh.columns
    return write_ply(path, {"vertex": columns, "face": mesh.faces}, comments)


def _without_specks(
    vertices: Float32[np.ndarray, "v 3"],
    faces: Int32[np.ndarray, "f 3"],
    values: Float[np.ndarray, "v c"],
) -> tuple[Float32[np.ndarray, "w 3"], Int32[np.ndarray, "g 3"], Float32[np.ndarray, "w c"]]:
    """The mesh without small parts and unused vertices."""
    links = scipy.sparse.coo_matrix(
        (np.ones(2 * len(faces), bool), (faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel())),
        shape=[len(vertices)] * 2,
    )
    _, part = scipy.sparse.csgraph.connected_components(links, directed=False)
    sizes = np.bincount(part[faces[:, 0]], minlength=1)
    faces = faces[sizes[part[faces[:, 0]]] >= SMALLEST_PART * sizes.max(initial=0)]
    used, flat = np.unique(faces, return_inverse=True)
    return vertices[used], flat.reshape(-1, 3).astype(np.int32), values[used]
