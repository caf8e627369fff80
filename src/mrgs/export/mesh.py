"""``mesh.ply``: triangles with a colour and a temperature per vertex, from renderings of the model.

The depth maps of the training cameras are fused into one truncated signed distance field in a band
about the surfaces (B. Curless and M. Levoy, "A Volumetric Method for Building Complex Models from
Range Images", 1996). Its zero level becomes triangles by naive surface nets (S. Gibson,
"Constrained Elastic Surface Nets", 1998, without the relaxation): one vertex per cell that the
surface crosses, at the mean of the crossings on its edges; one quad per crossed edge of the grid.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import scipy.ndimage
import scipy.sparse.csgraph
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64, UInt8

from mrgs.data.ply import write_ply
from mrgs.errors import RunError
from mrgs.export.job import ExportJob, comment_lines, described
from mrgs.export.surface_points import depth_maps, value_columns
from mrgs.runs.baked import BakedModel
from mrgs.scene import Scene
from mrgs.scene.depth_map import DepthMap, carry_over, visible

TRUNCATION_VOXELS = 4
"""Half width of the band."""

MIN_VIEWS = 2
"""A sample that fewer cameras saw is not known."""

BOUNDS_PERCENTILE = 2.0
"""On each axis, points beyond this percentile and its counterpart, far background, are left out."""


@dataclass(frozen=True, eq=False)
class Grid:
    """A regular grid: sample (i, j, k) is at ``origin`` + ``step`` · (i, j, k), scene units."""

    origin: Float64[np.ndarray, "3"]
    step: float
    shape: tuple[int, int, int]


def fuse(maps: Sequence[DepthMap], resolution: int) -> tuple[Float32[np.ndarray, "x y z"], Grid]:
    """The distance field of overlapping depth maps, in units of the truncation, positive before the
    surfaces, NaN where it is not known; with ``resolution`` samples along the longest side of the
    box about the scene, fewer where the pixels are coarser."""
    grid = _grid_of(maps, resolution)
    samples = np.argwhere(_band(maps, grid))
    positions = (grid.origin + grid.step * samples).astype(np.float32)
    total, count = np.zeros(len(samples), np.float32), np.zeros(len(samples), np.int32)
    truncation = TRUNCATION_VOXELS * grid.step
    for item in maps:
        rows, pixels, z = visible(item.camera, positions)
        distance = (item.depth[pixels] - z) / truncation
        seen = distance > -1  # false for NaN
        total[rows[seen]] += distance[seen].clip(max=1)
        count[rows[seen]] += 1
    field = np.full(grid.shape, np.nan, dtype=np.float32)
    known = count >= MIN_VIEWS
    field[tuple(samples[known].T)] = total[known] / count[known]
    return field, grid


def _grid_of(maps: Sequence[DepthMap], resolution: int) -> Grid:
    """A box about the seen points, its step no finer than the median pixel on the surfaces."""
    points = np.concatenate([item.points() for item in maps])
    low, high = np.percentile(points, [BOUNDS_PERCENTILE, 100 - BOUNDS_PERCENTILE], axis=0)
    surfaces = [(item.depth[np.isfinite(item.depth)], float(item.camera.K[0, 0])) for item in maps]
    pixel = np.median([np.median(depth) / focal for depth, focal in surfaces if len(depth)])
    step = max(float((high - low).max()) / resolution, float(pixel), 1e-6)
    margin = (TRUNCATION_VOXELS + 1) * step
    shape = np.ceil((high - low + 2 * margin) / step).astype(int) + 1
    return Grid(low - margin, step, (int(shape[0]), int(shape[1]), int(shape[2])))


def _band(maps: Sequence[DepthMap], grid: Grid) -> Bool[np.ndarray, "x y z"]:
    """The samples close to a seen surface."""
    band = np.zeros(grid.shape, dtype=bool)
    offsets = tuple(grid.step * k for k in range(-TRUNCATION_VOXELS, TRUNCATION_VOXELS + 1))
    for item in maps:
        for offset in offsets:
            points = item.points(offset)
            nearest = np.rint((points - grid.origin) / grid.step).astype(np.int64)
            nearest = nearest[((nearest >= 0) & (nearest < grid.shape)).all(axis=1)]
            band[tuple(nearest.T)] = True
    return scipy.ndimage.binary_dilation(band)


_CORNERS = np.array(list(product((0, 1), repeat=3)))
_EDGES = [
    (a, b)
    for a in range(8)
    for b in range(a + 1, 8)
    if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 1
]


def surface_nets(
    values: Float[np.ndarray, "x y z"],
) -> tuple[Float[np.ndarray, "v 3"], Int32[np.ndarray, "f 3"]]:
    """Triangles of the level 0 of signed distances, seen counter-clockwise from the positive side;
    none in cells that touch NaN. Returns vertices in grid coordinates (sample (i, j, k) is at i, j,
    k), and faces as rows of them."""
    inside = values < 0
    active = _active_cells(inside, np.isfinite(values))
    cells = np.argwhere(active)
    index = np.full(active.shape, -1, dtype=np.int32)
    index[active] = np.arange(len(cells), dtype=np.int32)
    quads = [_quads(inside, index, axis) for axis in range(3)]
    faces = np.concatenate(
        [quad[:, corners] for quad in quads for corners in ((0, 1, 2), (0, 2, 3))]
    )
    return _vertices(values, cells), faces


def _active_cells(
    inside: Bool[np.ndarray, "x y z"], known: Bool[np.ndarray, "x y z"]
) -> Bool[np.ndarray, "x-1 y-1 z-1"]:
    """Cells whose eight corners are known and lie on both sides."""
    count = np.zeros([size - 1 for size in inside.shape], dtype=np.uint8)
    complete = np.ones(count.shape, dtype=bool)
    for corner in _CORNERS:
        here = tuple(
            slice(offset, offset + size) for offset, size in zip(corner, count.shape, strict=True)
        )
        count += inside[here]
        complete &= known[here]
    return complete & (count > 0) & (count < 8)


def _vertices(
    values: Float[np.ndarray, "x y z"], cells: Int64[np.ndarray, "c 3"]
) -> Float[np.ndarray, "c 3"]:
    """The mean of the points where the edges of each cell cross the level."""
    at_corners = np.stack([values[tuple((cells + corner).T)] for corner in _CORNERS], axis=1)
    total, count = np.zeros((len(cells), 3)), np.zeros(len(cells))
    for a, b in _EDGES:
        first, second = at_corners[:, a], at_corners[:, b]
        crossed = (first < 0) != (second < 0)
        share = np.where(crossed, first, 0) / np.where(crossed, first - second, 1)
        total += crossed[:, None] * (_CORNERS[a] + share[:, None] * (_CORNERS[b] - _CORNERS[a]))
        count += crossed
    return cells + total / count[:, None]


def _quads(
    inside: Bool[np.ndarray, "x y z"], index: Int32[np.ndarray, "x-1 y-1 z-1"], axis: int
) -> Int32[np.ndarray, "q 4"]:
    """The quads around the crossed edges along an axis, with all four of their cells active."""
    along, u, v = np.roll(np.eye(3, dtype=np.int64), -axis, axis=0)
    ahead = np.roll(inside, -1, axis=axis)
    crossed = inside != ahead
    crossed[tuple(slice(-1, None) if i == axis else slice(None) for i in range(3))] = False
    start = np.argwhere(crossed)
    # The first and last samples across the axis have no cell on one side.
    across = [i for i in range(3) if i != axis]
    start = start[
        ((start[:, across] > 0) & (start[:, across] < np.array(index.shape)[across])).all(axis=1)
    ]
    around = np.stack([index[tuple((start - step).T)] for step in (u + v, v, 0 * along, u)], axis=1)
    outward = inside[tuple(start.T)]
    around = np.where(outward[:, None], around, around[:, ::-1])
    return around[(around >= 0).all(axis=1)]


RESOLUTION = 320
"""Samples along the longest side of the scene."""

SMALLEST_PART = 0.005
"""Connected parts with fewer than this share of the largest part's faces, specks, are left out."""


@dataclass(frozen=True, eq=False)
class ThermalMesh:
    """Triangles with a colour and a temperature per vertex: world coordinates, faces as rows of
    them, counter-clockwise from outside, and values by their names in files, see
    ``value_columns``."""

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
    values are the renderings' means. RunError if they show no surface."""
    maps = depth_maps(baked, scene)
    field, grid = fuse(maps, resolution)
    points, faces = surface_nets(field)
    vertices = (grid.origin + grid.step * points).astype(np.float32)
    values, cameras = carry_over(maps, vertices, 2 * grid.step)
    seen = (cameras[faces] > 0).all(axis=1)
    vertices, faces, values = _without_specks(vertices, faces[seen], values)
    if not len(faces):
        raise RunError(
            "the depths of the model's views agree nowhere, so there is no mesh: train it longer"
        )
    return ThermalMesh(vertices, faces, value_columns(baked, values))


def write_mesh_ply(path: Path, mesh: ThermalMesh, comments: Sequence[str] = ()) -> Path:
    """Write vertices with their values, and faces; returns the path."""
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
