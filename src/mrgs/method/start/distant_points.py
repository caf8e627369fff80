"""Start points far away, where photos show none: the sky, and what is too far for structure from
motion. Not in the paper. Without them Gaussians of the nearest surfaces fill these directions, grow
towards the cameras, and float in front of everything seen from elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from mrgs.scene import Camera, SceneBounds

CELLS_ACROSS = 24
"""Number of cells across a photo, which are about square. A direction counts if its
cell lies in three by three empty ones: smaller gaps lie on surfaces, and what is put behind these
makes them transparent."""

FEWEST_PER_CELL = 0.5
"""A photo with fewer start points per cell than this does not tell which directions are empty."""

SPACING_RAD = 0.1
"""Directions closer than about this become one point."""

AGREEMENT = 0.5
"""A distant point stays if at least this share of the photos that have it in their frame show
nothing there: behind a hole in a surface, other photos show that the surface goes on before it."""

BELOW_GROUND = 0.1
"""Where z points up, a distant point stays if it is no deeper below the lowest start points than
this share of its distance: photos that look down from a drone see nothing but ground, however few
start points are on it."""

LOWEST_SHARE = 0.01
"""Start points below this share of them may be strays."""


class DistantPoints(NamedTuple):
    """M points in world coordinates, about equally far apart; ``spacing`` is in scene units."""

    positions: Float[Tensor, "m 3"]
    spacing: float


def distant_points(
    points: Float[Tensor, "n 3"], cameras: Sequence[Camera], z_up: bool = False
) -> DistantPoints:
    """Points behind the start points, in cells of the photos that show none of these; ``z_up``
    where the world's z axis is known to point up."""
    if not cameras or len(points) == 0:
        return DistantPoints(points[:0], 0.0)
    ball = SceneBounds.of(points, cameras)
    spacing = SPACING_RAD * ball.background_distance
    told = [(camera, _empty_cells(camera, points.double())) for camera in cameras]
    empty = [(camera, cells) for camera, cells in told if cells is not None]
    if not empty:
        return DistantPoints(points[:0], spacing)
    directions = torch.cat([_on_sphere(camera, cells, ball) for camera, cells in empty])
    positions = ball.centre + ball.background_distance * _merged(directions)
    kept = _share_of_empty(positions, empty) >= AGREEMENT
    if z_up:
        lowest = max(1, round(LOWEST_SHARE * len(points)))
        ground = points[:, 2].double().kthvalue(lowest).values
        kept &= positions[:, 2] > ground - BELOW_GROUND * ball.background_distance
    return DistantPoints(positions[kept].to(points), spacing)


def _share_of_empty(
    positions: Float64[Tensor, "m 3"], empty: Sequence[tuple[Camera, Bool[Tensor, "rows columns"]]]
) -> Float64[Tensor, " m"]:
    """The share of the photos with a position in their frame that show nothing; NaN without any."""
    in_frame, nothing = torch.zeros(2, len(positions), dtype=torch.float64)
    for camera, cells in empty:
        pixels, _ = camera.project(positions)
        inside = camera.contains(pixels)
        in_frame[inside] += 1
        nothing[inside] += cells[_cells_at(pixels[inside], camera, len(cells))].double()
    return nothing / in_frame


def _empty_cells(
    camera: Camera, positions: Float64[Tensor, "n 3"]
) -> Bool[Tensor, "rows columns"] | None:
    """The cells without start points in them or in their neighbours; None with too few to tell."""
    rows = max(1, round(CELLS_ACROSS * camera.height / camera.width))
    pixels, _ = camera.project(positions)
    seen = pixels[camera.contains(pixels)]
    if len(seen) < FEWEST_PER_CELL * rows * CELLS_ACROSS:
        return None
    occupied = torch.zeros(rows, CELLS_ACROSS)
    occupied[_cells_at(seen, camera, rows)] = 1
    # Cells are 1 where they or one of those around them were.
    grown = partial(torch.nn.functional.max_pool2d, kernel_size=3, stride=1, padding=1)
    middles = grown(occupied[None]) == 0
    return grown(middles.float())[0] > 0


def _cells_at(
    pixels: Float64[Tensor, "n 2"], camera: Camera, rows: int
) -> tuple[Int64[Tensor, " n"], Int64[Tensor, " n"]]:
    """Row and column of the cells in which places of a photo lie."""
    size = pixels.new_tensor([camera.width, camera.height])
    column, row = (pixels / size * pixels.new_tensor([CELLS_ACROSS, rows])).long().T
    return row.clamp_max(rows - 1), column.clamp_max(CELLS_ACROSS - 1)


def _on_sphere(
    camera: Camera, empty: Bool[Tensor, "rows columns"], ball: SceneBounds
) -> Float64[Tensor, "k 3"]:
    """Directions from the background's centre to where rays through the cells' middles meet it."""
    rows, columns = empty.shape
    row, column = empty.nonzero().T
    pixels = torch.stack(
        [(column + 0.5) / columns * camera.width, (row + 0.5) / rows * camera.height], dim=1
    )
    ones = torch.ones(len(pixels), dtype=torch.float64)
    rays = camera.unproject(pixels.double(), ones) - camera.position
    rays = torch.nn.functional.normalize(rays, dim=1)
    start = camera.position - ball.centre
    along = rays @ start
    squared = along.square() - start.square().sum() + ball.background_distance**2
    length = squared.clamp_min(0).sqrt() - along
    return torch.nn.functional.normalize(start + length[:, None] * rays, dim=1)


def _merged(directions: Float64[Tensor, "k 3"]) -> Float64[Tensor, "m 3"]:
    """One direction for all that share a cell of a grid."""
    cells = (directions / SPACING_RAD).round().long()
    unique, cell_of = torch.unique(cells, dim=0, return_inverse=True)
    sums = torch.zeros(len(unique), 3, dtype=directions.dtype).index_add(0, cell_of, directions)
    return torch.nn.functional.normalize(sums, dim=1)
