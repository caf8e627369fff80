"""The pixels of an orthographic map, and the camera that draws them.

The rasterizer knows perspective cameras only. One that stands very far away, with a focal length to
match, is an orthographic one but for relief / distance: see ``docs/decisions``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from mrgs.scene import Camera

TIMES_AS_FAR = 1000.0
"""Distance of the camera from the map, in lengths of the map's longer side: relief of a tenth of
that side is displaced by at most 5e-5 of it."""


@dataclass(frozen=True, eq=False)
class MapGrid:
    """A map's plane and pixels. Map coordinates are u (to the right) and v (up) in map metres.

    Attributes:
        axes: right, up and out of the plane (towards the eye) as rows, unit length, in the scene's
            coordinates, [3, 3].
        scale: map metres per scene unit.
        offset: map coordinates of the scene's origin, [2].
        left: u of the left edge.
        top: v of the upper edge.
        pixel_m: side of a pixel, map metres.
        width: pixels.
        height: pixels.
        slab: lowest and highest coordinate along ``out`` (scene units) of what is drawn.
    """

    axes: Float64[np.ndarray, "3 3"]
    scale: float
    offset: Float64[np.ndarray, "2"]
    left: float
    top: float
    pixel_m: float
    width: int
    height: int
    slab: tuple[float, float]

    def to_map(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
        """Map coordinates of points of the scene, [N, 2]."""
        return self.scale * np.einsum("ij,nj->ni", self.axes[:2], points) + self.offset

    @property
    def lower_left(self) -> Float64[np.ndarray, "3"]:
        """The lower left corner of the map in the scene's coordinates, in the middle of the
        slab."""
        return self._on_plane(self.left, self.top - self.height * self.pixel_m, sum(self.slab) / 2)

    def camera(self, column: int, row: int, width: int, height: int) -> Camera:
        """The camera of a part of the map, whose upper left pixel is (column, row).

        Its optical axis goes through the middle of the whole map, so that the parts fit.
        """
        pixel = self.pixel_m / self.scale
        distance = TIMES_AS_FAR * pixel * max(self.width, self.height)
        half_width, half_height = self.width / 2, self.height / 2
        middle = self._on_plane(
            self.left + half_width * self.pixel_m,
            self.top - half_height * self.pixel_m,
            sum(self.slab) / 2,
        )
        right, up, out = self.axes
        rotation = np.stack([right, -up, -out])
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation
        viewmat[:3, 3] = -np.einsum("ij,j->i", rotation, middle + distance * out)
        focal = distance / pixel
        K = [[focal, 0.0, half_width - column], [0.0, focal, half_height - row], [0.0, 0.0, 1.0]]
        return Camera(K, viewmat, width, height)

    @property
    def middles(self) -> tuple[Float64[np.ndarray, " w"], Float64[np.ndarray, " h"]]:
        """Map coordinates of the middles of the columns and of the rows."""
        u = self.left + self.pixel_m * (np.arange(self.width) + 0.5)
        v = self.top - self.pixel_m * (np.arange(self.height) + 0.5)
        return u, v

    def window_of(self, points: Float64[np.ndarray, "n 3"]) -> tuple[slice, slice]:
        """The rows and columns of the smallest part of the map that holds points of the scene, as
        far as they lie in it."""
        if not len(points):
            return slice(0, 0), slice(0, 0)
        u, v = self.to_map(points).T
        columns, rows = (u - self.left) / self.pixel_m, (self.top - v) / self.pixel_m
        return _span(rows, self.height), _span(columns, self.width)

    def inside(self, means: Float64[np.ndarray, "n 3"]) -> np.ndarray:
        """Whether points lie in the slab, [N]."""
        low, high = self.slab
        along = np.einsum("nj,j->n", means, self.axes[2])
        return (along >= low) & (along <= high)

    def _on_plane(self, u: float, v: float, along: float) -> Float64[np.ndarray, "3"]:
        across = (np.array([u, v]) - self.offset) / self.scale
        return np.einsum("i,ij->j", np.append(across, along), self.axes)


def unprojected(camera: Camera, depth: np.ndarray) -> Float64[np.ndarray, "h w 3"]:
    """The points of the scene in the middles of a map's pixels, for z-depths [H, W]."""
    return camera.unproject_image(torch.from_numpy(depth.astype(np.float64))).numpy()


def _span(places: Float64[np.ndarray, " n"], size: int) -> slice:
    """The pixels from the smallest to the largest place, within the map."""
    first, last = np.clip([np.floor(places.min()), np.floor(places.max()) + 1], 0, size)
    return slice(int(first), int(last))
