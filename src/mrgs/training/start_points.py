"""The points that training starts from: the scene's, those far away, and what the photos say of both.

Only the scene's points and their colours are as in 3DGS. They have no temperatures: from one value for all, a short
schedule spends its first third on temperatures that every photo shows, and surfaces whose temperature is the
background's never become opaque to the thermal blend.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.scene import PosedImage, Scene
from mrgs.training.config import TrainConfig
from mrgs.training.distance import distant_points
from mrgs.training.photo_values import UNSEEN, photo_values

OPACITY = 0.1
"""3DGS's."""

THERMAL_OPACITY = 0.5
"""o_t of a point whose temperature the photos tell. Started with 3DGS's, a surface that is as cold everywhere as what
lies behind it would stay half transparent: nothing in a thermal photo asks it to become opaque."""

DISTANT_OPACITY = 0.9
"""Nothing lies behind a distant point; and were it not opaque, the nearer surfaces would grow to fill the sky."""


class StartPoints(NamedTuple):
    """N points.

    Attributes:
        positions: in world coordinates, [N, 3].
        colors: RGB in [0, 1], [N, 3].
        temperatures: normalised, [N].
        opacities_rgb: o_c, [N].
        opacities_thermal: o_t, [N].
    """

    positions: Float[Tensor, "n 3"]
    colors: Float[Tensor, "n 3"]
    temperatures: Float[Tensor, " n"]
    opacities_rgb: Float[Tensor, " n"]
    opacities_thermal: Float[Tensor, " n"]

    def rows(self, chosen: Tensor) -> StartPoints:
        """Some of the points."""
        return StartPoints(*(values[chosen] for values in self))


def start_points(scene: Scene, config: TrainConfig) -> StartPoints:
    """The scene's points first, then those far away, as far as the configuration asks for them and for temperatures."""
    positions, colors = scene.points.positions, scene.points.colors
    opacities = positions.new_full((len(positions),), OPACITY)
    if config.distant_points:
        distant = distant_points(positions, [view.cameras[0] for view in scene.train])
        positions = torch.cat([positions, distant])
        photos = _photos(scene, "rgb") if len(distant) > 0 else []
        colors = torch.cat([colors, photo_values(positions, photos, 3)[len(colors) :]])
        opacities = torch.cat([opacities, opacities.new_full((len(distant),), DISTANT_OPACITY)])
    temperatures = positions.new_full((len(positions),), UNSEEN)
    opacities_thermal = opacities
    if config.photo_temperatures:
        temperatures = photo_values(positions, _photos(scene, "thermal"), 1)[:, 0]
        opacities_thermal = opacities.clamp_min(THERMAL_OPACITY)
    return StartPoints(positions, colors, temperatures, opacities, opacities_thermal)


def _photos(scene: Scene, modality: str) -> list[PosedImage]:
    photos = [getattr(view, modality) for view in scene.train]
    return [photo for photo in photos if photo is not None]
