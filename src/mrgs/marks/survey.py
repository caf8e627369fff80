"""What the thermal photos' cameras see of a model's surfaces."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from mrgs.marks.surface import SurfaceRenderer, seen_depth
from mrgs.scene import Camera
from mrgs.scene.depth_map import MAX_VIEWS, DepthMap
from mrgs.scene.view import evenly_spaced

SURVEY_WIDTH_PX = 160
"""Width of the images that tell which photos see a place."""


class PhotoSurvey:
    """Small depth images of the photos' cameras, rendered when they are first asked for.

    Args:
        render: renders the model with the depth of its surfaces.
        cameras: of the photos.

    Attributes:
        chosen: indices of the cameras that are surveyed, at most ``MAX_VIEWS``, spread evenly.
        cameras: those cameras.
    """

    def __init__(self, render: SurfaceRenderer, cameras: Sequence[Camera]) -> None:
        self.chosen = evenly_spaced(len(cameras), MAX_VIEWS)
        self._render = render
        self.cameras = [cameras[index] for index in self.chosen]
        self._maps: list[DepthMap] = []

    def __len__(self) -> int:
        return len(self.chosen)

    def __iter__(self) -> Iterator[DepthMap]:
        """The depth image of each camera that is surveyed, in the order of ``chosen``."""
        if not self._maps:
            self._maps = [self._map(camera) for camera in self.cameras]
        return iter(self._maps)

    def _map(self, camera: Camera) -> DepthMap:
        small = camera.with_width(min(camera.width, SURVEY_WIDTH_PX))
        depth = seen_depth(self._render(small)).astype(np.float32)
        return DepthMap(small, depth, depth[..., None])
