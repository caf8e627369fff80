"""Where the marks are: seen from above, or where all cameras face one side, from the front."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float32, Float64
from PIL import Image, ImageDraw

from mrgs.marks.mark import Mark
from mrgs.pictures.drawing import INK, MUTED, draw_text
from mrgs.pictures.palette import round_down
from mrgs.report.overlays import LABEL_PX, RIM, draw_names, draw_place, small_picture
from mrgs.scene import Scene

WIDTH_PX, HEIGHT_PX, MARGIN_PX = 1440, 840, 40
SMALL_RADIUS_PX = 22
MOST_POINTS = 20_000
TRIMMED_PERCENT = 4.0
"""Of the start points on each side: what strays far off does not shrink the plan."""

FACES_ONE_SIDE = 0.7
"""Length of the mean of the cameras' level directions above which they look at one side."""

FADED = 0.45
"""Share of white in the colours of the surfaces, so that the marks stand out."""

PAPER, CAMERA = (255, 255, 255), (31, 95, 168)


class Plan:
    """The start points of a scene in their colours, on which marks are drawn.

    Args:
        scene: with its cameras.
        marks: that the plan must reach.

    Attributes:
        from_the_front: whether it is an elevation, along the cameras' mean level direction; else it
            is seen from above, along the scene's z axis.
    """

    def __init__(self, scene: Scene, marks: Sequence[Mark]) -> None:
        self.from_the_front = faces_one_side(scene)
        self._metric, self._north = scene.world.metric, scene.world.north
        self._axes = _axes(_level_direction(scene) if self.from_the_front else None)
        points, colors = scene.points.positions.double().numpy(), scene.points.colors.numpy()
        step = max(1, len(points) // MOST_POINTS)
        flat = points[::step] @ self._axes.T
        cameras = np.stack([camera.position.numpy() for camera in scene.train_cameras])
        self._cameras = np.empty((0, 2)) if self.from_the_front else (cameras @ self._axes.T)[:, :2]
        low, high = np.percentile(flat[:, :2], [TRIMMED_PERCENT, 100 - TRIMMED_PERCENT], axis=0)
        reached = [self._flat(mark) for mark in marks]
        reached += [self._cameras] if len(self._cameras) else []
        self._low = np.min([low, *(each.min(axis=0) for each in reached)], axis=0)
        self._high = np.max([high, *(each.max(axis=0) for each in reached)], axis=0)
        size = np.array([WIDTH_PX, HEIGHT_PX]) - 2 * MARGIN_PX
        self._scale = float((size / np.maximum(self._high - self._low, 1e-9)).min())
        self._ground = self._draw_ground(flat, colors[::step])

    def whole(self, marks: Mapping[str, Mark]) -> Image.Image:
        """The plan with all marks under their names."""
        image = self._ground.copy()
        for mark in marks.values():
            draw_place(image, mark, self._pixels(self._flat(mark)), LABEL_PX / 4)
        middles = {
            name: self._pixels(self._flat(mark)).mean(axis=0) for name, mark in marks.items()
        }
        draw_names(image, {name: (float(x), float(y)) for name, (x, y) in middles.items()})
        self._draw_scale(image)
        return image

    def small(self, mark: Mark) -> Image.Image:
        """The plan with one mark, for beside its pictures."""
        image = self._ground.copy()
        draw_place(image, mark, self._pixels(self._flat(mark)), SMALL_RADIUS_PX)
        return small_picture(image)

    def _draw_ground(
        self, flat: Float64[np.ndarray, "n 3"], colors: Float32[np.ndarray, "n 3"]
    ) -> Image.Image:
        """The surfaces, the farthest first, and the cameras."""
        image = Image.new("RGB", (WIDTH_PX, self._height), PAPER)
        draw = ImageDraw.Draw(image)
        inside = ((flat[:, :2] >= self._low) & (flat[:, :2] <= self._high)).all(axis=1)
        order = np.flatnonzero(inside)[np.argsort(flat[inside, 2])]
        shades = (255 * (FADED + (1 - FADED) * colors[order])).astype(int)
        for (x, y), shade in zip(self._pixels(flat[order, :2]), shades.tolist(), strict=True):
            draw.rectangle((x - 2, y - 2, x + 2, y + 2), fill=tuple(shade))
        for x, y in self._pixels(self._cameras):
            draw.polygon([(x, y - 10), (x + 9, y + 6), (x - 9, y + 6)], fill=CAMERA, outline=RIM)
        return image

    def _draw_scale(self, image: Image.Image) -> None:
        """A bar of a round length in m, and an arrow to the north, where the scene has them."""
        draw, bottom = ImageDraw.Draw(image), image.height - 14
        if self._metric:
            length = round_down(0.2 * WIDTH_PX / self._scale)
            end = MARGIN_PX + length * self._scale
            draw.line((MARGIN_PX, bottom, end, bottom), fill=INK, width=4)
            draw_text(image, (end + 10, bottom + 4), f"{length:g} m", 20, MUTED)
        if self._north and not self.from_the_front:
            x, y = WIDTH_PX - MARGIN_PX, MARGIN_PX
            draw.polygon([(x, y - 30), (x + 11, y + 6), (x, y - 3), (x - 11, y + 6)], fill=INK)
            draw_text(image, (x, y + 28), "N", 22, INK, anchor="ms")

    @property
    def _height(self) -> int:
        return round((self._high - self._low)[1] * self._scale) + 2 * MARGIN_PX

    def _flat(self, mark: Mark) -> Float64[np.ndarray, "n 2"]:
        return (np.array(mark.points) @ self._axes.T)[:, :2]

    def _pixels(self, flat: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        """Pixels of places in the plan's plane."""
        middle = flat - (self._low + self._high) / 2
        return np.array([WIDTH_PX, self._height]) / 2 + self._scale * middle * (1, -1)


def faces_one_side(scene: Scene) -> bool:
    """Whether the cameras of a scene look at one side of it, as at a façade."""
    return bool(np.linalg.norm(_level_direction(scene)) > FACES_ONE_SIDE)


def _level_direction(scene: Scene) -> Float64[np.ndarray, "3"]:
    """The mean of the cameras' directions, without its vertical part."""
    forward = np.stack([camera.forward.numpy() for camera in scene.train_cameras])
    level: Float64[np.ndarray, "3"] = forward.mean(axis=0) * (1, 1, 0)
    return level


def _axes(level: Float64[np.ndarray, "3"] | None) -> Float64[np.ndarray, "3 3"]:
    """Rows: to the right, up, and towards the onlooker, who looks level, or down if None."""
    if level is None:
        return np.eye(3)
    towards, up = -level / np.linalg.norm(level), np.array([0.0, 0.0, 1.0])
    return np.stack([np.cross(up, towards), up, towards])
