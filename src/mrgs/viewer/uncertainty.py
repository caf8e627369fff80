"""A picture of how far the model's temperatures may be from the truth."""

from __future__ import annotations

import threading

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.rasterizer import Layer, rasterize
from mrgs.render import Model
from mrgs.scene import THERMAL, Blend, Camera, TemperatureRange
from mrgs.scene.rendering import SOLID_ALPHA
from mrgs.viewer.board import MarkBoard
from mrgs.viewer.fields import PaneImages
from mrgs.viewer.source import Source

LEAST_SEEN = 0.5
"""A pixel of which less was seen by a thermal photo has no value."""


class UncertaintyPictures:
    """Draws the uncertainty: computed once at each splat that a thermal photo sees, then blended as
    temperatures are.

    Args:
        board: has the meter, by what the survey states now, and the surfaces that have an
            emissivity of their own.
        source: gives access to the model.
        temperature: the scale of the thermal values; None without known °C.
    """

    def __init__(
        self, board: MarkBoard, source: Source, temperature: TemperatureRange | None
    ) -> None:
        self._board = board
        self._source = source
        self._temperature = temperature
        self._of_splats: Float[Tensor, " n"] | None = None
        self._lock = threading.Lock()

    def images(self, camera: Camera) -> PaneImages:
        """The uncertainty in the unit of the temperatures; NaN where no thermal photo looked.

        The first call renders all thermal photos.

        Raises:
            SceneError: a photo cannot be read.
        """
        meter = self._board.uncertainty
        assert meter is not None
        with self._lock:
            if self._of_splats is None:
                means = self._source.run(lambda model: model.gaussians.means.detach().cpu())
                found = meter.of_photos(means.float().numpy())
                self._of_splats = torch.from_numpy(found)
            of_splats = self._of_splats
        blend = self._source.run(lambda model: _blend(model, camera, of_splats))
        alpha = blend.alpha.clamp_min(SOLID_ALPHA)
        doubt, seen, value = (blend.image[..., i].double().numpy() for i in range(3))
        solid = (blend.alpha.numpy() >= SOLID_ALPHA) & (seen >= LEAST_SEEN * alpha.numpy())
        of_photos = np.where(solid, doubt / np.maximum(seen, 1e-9), np.nan)
        if self._temperature is not None:
            value = self._temperature.to_celsius(value)
        depth = blend.depth / alpha
        points = camera.unproject_image(depth.double()).numpy()
        eye = camera.position.double().numpy()
        total = meter.together(of_photos, points, value, self._board.regions, eye)
        return PaneImages({THERMAL: total.astype(np.float32)}, depth.numpy(), solid)


def _blend(model: Model, camera: Camera, of_splats: Float[Tensor, " n"]) -> Blend:
    """Uncertainty, share that photos see, and temperature, blended with the thermal opacities."""
    gaussians = model.gaussians
    with torch.no_grad():
        seen = of_splats.isfinite()
        values = model.values(THERMAL, camera.position.to(gaussians.means), sh_degree=0)[:, 0]
        features = torch.stack([of_splats.nan_to_num(), seen.float(), values.cpu()], dim=1)
        features = features.to(gaussians.means)
        layer = Layer(gaussians.opacity(THERMAL), features, features.new_zeros(3))
        quats = torch.nn.functional.normalize(gaussians.quats, dim=1)
        return rasterize(
            gaussians.means, quats, gaussians.scales, [layer], camera.viewmat, camera.K,
            camera.width, camera.height, dilation_px2=model.dilation.of(camera),
        ).blends[0]  # fmt: skip
