"""How much the projected Gaussians of a model are dilated, by the camera."""

from __future__ import annotations

from dataclasses import dataclass

from mrgs.rasterizer.contract import DILATION_PX2
from mrgs.scene import Camera

LEAST_DILATION_PX2 = 0.01
"""With less, the edges of needles would show the 1/256 px to which WebGL rounds places."""


@dataclass(frozen=True)
class Dilation:
    """What is added to the diagonal of projected covariances (d in ``rasterizer.contract``).

    Attributes:
        px2: variance in px².
        finest_focal_px: focal length in pixels of the finest photos. Cameras with coarser pixels
            dilate by the same angle rather than by the same number of pixels; otherwise small
            images would show everything too thick. None: the same px² for every camera, as in
            3DGS.
    """

    px2: float = DILATION_PX2
    finest_focal_px: float | None = None

    def of(self, camera: Camera) -> float:
        """The dilation in a camera's image, px²; ``dilation.js`` says the same."""
        if self.finest_focal_px is None:
            return self.px2
        fineness = min(1.0, camera.focal_px / self.finest_focal_px)
        return max(LEAST_DILATION_PX2, self.px2 * fineness**2)


AS_PUBLISHED = Dilation()
"""That of 3DGS and the paper."""
