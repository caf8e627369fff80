"""A room of two walls, the nearer one hiding part of the farther, photographed by two cameras with
exact truth.

Surfaces are tiled with materials; each has a brightness and, unrelated to it, a temperature. So
edges agree between the photo and the thermal image, and contrasts do not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from mrgs.prepare.rig.adjust import rigid_motion
from mrgs.prepare.rig.contract import RigCalibration, RigPair
from mrgs.prepare.rig.refine import thermal_rays
from mrgs.scene import Camera, Pixels, PointCloud, PosedImage
from mrgs.scene.lens import Lens

RGB = Lens(320, 240, 230.0, 230.0, 160.0, 120.0)
THERMAL = Lens(160, 120, 150.0, 150.6, 77.0, 63.0, (-0.15, 0.05, 0.0, 0.0))
THERMAL_FROM_RGB = rigid_motion(
    torch.tensor([0.02, -0.05, 0.015, 0.12, 0.03, -0.02], dtype=torch.float64)
)
NEAR_M, FAR_M = 3.0, 5.0
_NEAR_EDGES = (-0.9, 0.8, -0.8, 1.0)


@dataclass(frozen=True, eq=False)
class Board:
    """A chessboard with a margin; inner corner (i, j) is at (i, j, 0) squares in its axes.

    Attributes:
        world_from_board: motion from its axes, in metres, to the world's.
        inner: corners in a row and in a column.
        square_m: width of a square.
    """

    world_from_board: np.ndarray
    inner: tuple[int, int] = (6, 5)
    square_m: float = 0.1

    @property
    def corners(self) -> np.ndarray:
        """In the world, row by row."""
        plane = np.stack(np.meshgrid(*(np.arange(count) for count in self.inner)), axis=-1).reshape(
            -1, 2
        )
        flat = np.column_stack([plane * self.square_m, np.zeros(len(plane))])
        return flat @ self.world_from_board[:3, :3].T + self.world_from_board[:3, 3]

    def over(
        self, values: np.ndarray, centre: np.ndarray, rays: np.ndarray, shades: tuple[float, float]
    ) -> np.ndarray:
        """The values seen along rays from a centre, with the board before them; its squares have
        two shades."""
        turn, place = self.world_from_board[:3, :3], self.world_from_board[:3, 3]
        reach = ((place - centre) @ turn[:, 2]) / (rays @ turn[:, 2])
        x, y = np.moveaxis(
            (centre + reach[..., None] * rays - place) @ turn[:, :2] / self.square_m, -1, 0
        )
        columns, rows = self.inner
        inside = (x > -1) & (x < columns) & (y > -1) & (y < rows) & (reach > 0)
        margin = (x > -1.4) & (x < columns + 0.4) & (y > -1.4) & (y < rows + 0.4) & (reach > 0)
        squares = np.where((np.floor(x) + np.floor(y)) % 2 == 0, *shades)
        return np.where(inside, squares, np.where(margin, max(shades), values))


@dataclass(frozen=True, eq=False)
class Room:
    """Pairs of the room, their points, and the truth."""

    pairs: list[RigPair]
    points: PointCloud
    motions: list[torch.Tensor]

    lens: Lens = THERMAL
    extrinsics: torch.Tensor = THERMAL_FROM_RGB

    def errors_px(self, found: RigCalibration) -> list[float]:
        """For each pair, the median distance between where its thermal camera shows points and
        where it truly does."""
        errors = []
        for index, pair in enumerate(self.pairs):
            world = torch.cat(
                [self.points.positions.double(), torch.ones(len(self.points.positions), 1)], dim=1
            )
            rgb = world @ pair.photo.camera.viewmat.T
            true = self.pixels(self.lens, rgb @ (self.motions[index] @ self.extrinsics).T)
            own = self.pixels(
                found.lens, rgb @ (found.views[index].correction @ found.extrinsics).T
            )
            seen = ((true > 0) & (true < (self.lens.width, self.lens.height))).all(axis=1)
            errors.append(float(np.median(np.linalg.norm(own - true, axis=1)[seen])))
        return errors

    @staticmethod
    def pixels(lens: Lens, points: torch.Tensor) -> np.ndarray:
        x, y, z = points[:, :3].T.numpy()
        u, v = lens.distort(x / z, y / z)
        return np.column_stack([u * lens.fx + lens.cx, v * lens.fy + lens.cy])


@cache
def _tiles(far: bool) -> cKDTree:
    return cKDTree(np.random.default_rng(7 + far).uniform(-6, 6, (900, 2)))


def materials(position: np.ndarray, far: np.ndarray) -> np.ndarray:
    """The material, 0 to 63, at points of the walls: irregular tiles, those nearest to scattered
    centres."""
    tile = np.empty(far.shape, dtype=np.int64)
    for wall, chosen in ((False, ~far), (True, far)):
        tile[chosen] = _tiles(wall).query(position[chosen, :2])[1]
    return tile % 64


@cache
def rays_of(lens: Lens) -> np.ndarray:
    """The rays (x, y, 1) of 2×2 points in each pixel."""
    return thermal_rays(lens, 2 * lens.width, 2 * lens.height)


def picture(
    lens: Lens,
    viewmat: np.ndarray,
    of_material: np.ndarray,
    blur_px: float,
    board: Board | None = None,
    shades: tuple[float, float] = (0.0, 1.0),
) -> torch.Tensor:
    """What a camera with this lens and pose sees."""
    rays = np.einsum("hwj,ji->hwi", rays_of(lens), viewmat[:3, :3])
    centre = -viewmat[:3, :3].T @ viewmat[:3, 3]
    near = centre + rays * ((NEAR_M - centre[2]) / rays[..., 2])[..., None]
    left, right, top, bottom = _NEAR_EDGES
    on_near = (
        (near[..., 0] > left)
        & (near[..., 0] < right)
        & (near[..., 1] > top)
        & (near[..., 1] < bottom)
    )
    far = centre + rays * ((FAR_M - centre[2]) / rays[..., 2])[..., None]
    values = of_material[materials(np.where(on_near[..., None], near, far), ~on_near)]
    if board is not None:
        values = board.over(values, centre, rays, shades)
    values = values.reshape(lens.height, 2, lens.width, 2).mean(axis=(1, 3))
    return torch.from_numpy(gaussian_filter(values, blur_px).astype(np.float32))


def walls(count: int) -> PointCloud:
    """Points on both walls; those of the far one that the near one hides are among them."""
    rng = np.random.default_rng(1)
    left, right, top, bottom = _NEAR_EDGES
    near = np.column_stack(
        [rng.uniform(left, right, count), rng.uniform(top, bottom, count), np.full(count, NEAR_M)]
    )
    far = np.column_stack(
        [rng.uniform(-5, 5, count), rng.uniform(-4, 4, count), np.full(count, FAR_M)]
    )
    positions = torch.from_numpy(np.concatenate([near, far])).float()
    return PointCloud(positions, torch.full_like(positions, 0.5))


def build_room(
    views: int = 6,
    motion_rad: float = 0.0,
    inverted: bool = False,
    boards: Sequence[Board | None] = (),
) -> Room:
    """Pairs around the room.

    Args:
        views: how many pairs.
        motion_rad: by how much the thermal camera turns between the shutters.
        inverted: whether what is bright is cold.
        boards: one before each pair; its bright squares are cold.
    """
    rng = np.random.default_rng(0)
    brightness = rng.uniform(0, 1, 64)
    temperature_c = 20 + 10 * (1 - brightness if inverted else rng.uniform(0, 1, 64))
    K = torch.tensor([[RGB.fx, 0, RGB.cx], [0, RGB.fy, RGB.cy], [0, 0, 1]], dtype=torch.float64)
    pairs, motions = [], []
    for view in range(views):
        turn = rng.normal(0, 0.06, 3)
        place = rng.normal(0, 0.25, 3) * [1, 1, 0.6]
        viewmat = rigid_motion(torch.from_numpy(np.concatenate([turn, -place])))
        motion = rigid_motion(
            torch.cat([torch.from_numpy(rng.normal(0, motion_rad, 3)), torch.zeros(3)])
        )
        board = boards[view] if boards else None
        rgb = picture(RGB, viewmat.numpy(), brightness, 0.5, board)[..., None].expand(-1, -1, 3)
        thermal_viewmat = (motion @ THERMAL_FROM_RGB @ viewmat).numpy()
        thermal = picture(THERMAL, thermal_viewmat, temperature_c, 1.0, board, (27.0, 22.0))[
            ..., None
        ]
        camera = Camera(K, viewmat, RGB.width, RGB.height)
        pairs.append(
            RigPair(
                f"view_{view}", PosedImage(camera, _returns(Pixels(rgb))), _returns(Pixels(thermal))
            )
        )
        motions.append(motion)
    return Room(pairs, walls(1500), motions)


def _returns(pixels: Pixels) -> Callable[[], Pixels]:
    return lambda: pixels


def make_board(motion: Sequence[float], **facts) -> Board:
    """A board at a place: motion is six numbers, a rotation vector and a translation."""
    return Board(rigid_motion(torch.tensor(motion, dtype=torch.float64)).numpy(), **facts)


def draw_board(
    board: Board, lens: Lens, shades=(0.2, 0.8), blur_px: float = 0.5
) -> tuple[np.ndarray, np.ndarray]:
    """A sharp drawing of a board from the origin, and its corners."""
    x, y = np.meshgrid(
        (np.arange(4 * lens.width) + 0.5) / 4, (np.arange(4 * lens.height) + 0.5) / 4
    )
    x, y = (x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy
    if not lens.is_pinhole:
        x, y = lens.undistort(x, y)
    values = board.over(
        np.full(x.shape, 0.5), np.zeros(3), np.stack([x, y, np.ones_like(x)], axis=-1), shades
    )
    image = values.reshape(lens.height, 4, lens.width, 4).mean(axis=(1, 3))
    return gaussian_filter(image, blur_px), Room.pixels(lens, torch.from_numpy(board.corners))
