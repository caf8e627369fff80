"""What every rasterizer takes and returns.

The image model, for the Gaussian i, the pixel centre x' and a layer with opacities o:

    α_i = min(0.999, o_i · exp(−½ (x' − μ'_i)ᵀ Σ'_i⁻¹ (x' − μ'_i)))   (the paper's alpha blending)
    w_i = α_i · T_i,  T_i = Π_{j<i} (1 − α_j)     front to back by distance, ties by index
    image = Σ w_i f_i + T_end · background,  depth = Σ w_i z_i,  alpha = 1 − T_end

μ' is the perspective projection, Σ' = J R_w Σ R_wᵀ Jᵀ + d I the EWA projection (px²) with the
dilation d, 0.3 px² in 3DGS. The distance is that of μ from the camera's centre; 3DGS sorts by z,
so that the order, and with it the image, depends on where a camera points. A Gaussian is left out
of a pixel where α_i < 1/255, and a pixel is finished once T < 1e-4 (the Gaussian that brings T
below still counts). The depth is not divided by alpha, as in the paper.

J expands the projection to first order about the centre, which means nothing for a Gaussian that
reaches the plane of the camera: one whose standard deviation along the view's axis exceeds its
depth z is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.scene import Blend, Camera, Gaussians

NEAR_PLANE = 0.01
"""Gaussians whose centre is closer to the image plane are left out (scene units)."""

DILATION_PX2 = 0.3
"""d of 3DGS, added to the projected covariance: no Gaussian is much thinner than a pixel."""

ALPHA_MAX = 0.999
ALPHA_MIN = 1.0 / 255.0
TRANSMITTANCE_MIN = 1e-4

SURFACE_TRANSMITTANCES = (0.6, 0.4)
"""The surface that a ray meets is what brings T from the first to the second."""

STEEPEST = 4.0
"""Largest ratio of the depth at which a ray meets a Gaussian to that of its centre: a plane seen at
a grazing angle would be met at infinity."""

STEEPEST_TANGENT = 10.0
"""Steepest rise of a Gaussian's plane, in units of depth per unit across (84°)."""

FRUSTUM_MARGIN = 0.3
"""x/z and y/z are clamped in the Jacobian J to an image wider by this share of half its view."""


class Geometry(NamedTuple):
    """Where N Gaussians are, and their extents.

    Attributes:
        means: centres in world coordinates, [N, 3].
        quats: rotations wxyz, normalised by the rasterizer, [N, 4].
        scales: standard deviations, [N, 3].
    """

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]

    @classmethod
    def of(cls, gaussians: Gaussians) -> Geometry:
        """The geometry of a model."""
        return cls(gaussians.means, gaussians.quats, gaussians.scales)


class Projection(NamedTuple):
    """A camera, as a rasterizer sees it; sizes in pixels.

    Attributes:
        viewmat: world to camera (OpenCV axes), [4, 4].
        K: intrinsics in pixels, [3, 3]; pixel centres lie at +0.5.
        dilation_px2: d, above 0.
    """

    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    width: int
    height: int
    dilation_px2: float = DILATION_PX2

    def to(self, like: Tensor) -> Projection:
        """The same with matrices of a tensor's type, on its device."""
        return self._replace(viewmat=self.viewmat.to(like), K=self.K.to(like))


class Layer(NamedTuple):
    """One modality to be blended: its own opacities over the shared geometry.

    Attributes:
        opacities: o in (0, 1), [N].
        features: what is blended: RGB (C = 3) or normalised temperature (C = 1), [N, C].
        background: what is seen where nothing blocks the view, [C].
    """

    opacities: Float[Tensor, " n"]
    features: Float[Tensor, "n c"]
    background: Float[Tensor, " c"]


class Raster(NamedTuple):
    """The result of a rasterizer: a Blend per layer, in their order; and the largest distance in
    pixels from the centre of each Gaussian at which α reaches 1/255 in any layer, 0 for those that
    are left out, without gradient."""

    blends: tuple[Blend, ...]
    radii: Float[Tensor, " n"]


LEAST_DILATION_PX2 = 0.01
"""Least dilation: with less, edges of needles would show the 1/256 px to which WebGL rounds."""


@dataclass(frozen=True)
class Dilation:
    """What is added to the diagonal of projected covariances (d in ``rasterizer.contract``): a
    variance of ``px2`` px². Cameras with coarser pixels than those of the finest photos, whose
    focal length is ``finest_focal_px``, dilate by the same angle rather than by as many pixels;
    otherwise small images would show everything too thick. None: the same px² for every camera, as
    in 3DGS."""

    px2: float = DILATION_PX2
    finest_focal_px: float | None = None

    def of(self, camera: Camera) -> float:
        """The dilation in a camera's image, px²; ``dilation.js`` computes the same."""
        if self.finest_focal_px is None:
            return self.px2
        fineness = min(1.0, camera.focal_px / self.finest_focal_px)
        return max(LEAST_DILATION_PX2, self.px2 * fineness**2)

    def projection(self, camera: Camera, device: torch.device) -> Projection:
        """A camera's projection on a device, with this dilation and without the pose's gradient."""
        K, viewmat, _ = camera.tensors(device)
        return Projection(viewmat.detach(), K, camera.width, camera.height, self.of(camera))
