"""The points that training starts from: the scene's, those far away, and what the photos say of
both.

Only the scene's points and their colours are as in 3DGS. They have no temperatures: from one value
for all, a short schedule spends its first third on temperatures that every photo shows, and
surfaces whose temperature is the background's never become opaque to the thermal blend.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.method.config import TrainConfig
from mrgs.method.start.distant_points import distant_points
from mrgs.method.start.photo_values import photo_values
from mrgs.scene import PointCloud, PosedImage, Scene

OPACITY = 0.1
"""3DGS's."""

THERMAL_OPACITY = 0.5
"""o_t of a point whose temperature the photos tell. Started with 3DGS's, a surface that is as cold
everywhere as what lies behind it would stay half transparent: nothing in a thermal photo asks it to
become opaque."""

UNSEEN = 0.5
"""Colour and temperature of a point that no photo shows."""

DISTANT_OPACITY = 0.9
"""Nothing lies behind a distant point; and were it not opaque, the nearer surfaces would grow to
fill the sky."""

DISTANT_SIZE = 2.0
"""Largest standard deviation of a distant point at the start, in spacings: one or two of them
behind a small hole have the scene's points as neighbours, and would start as a blob that reaches up
to the scene."""


class StartPoints(NamedTuple):
    """N points.

    Attributes:
        positions: in world coordinates, [N, 3].
        colors: RGB in [0, 1], [N, 3].
        temperatures: normalised, [N].
        opacities_rgb: o_c, [N].
        opacities_thermal: o_t, [N].
        max_scales: no Gaussian starts larger than this, scene units, [N]; infinite where the
            spacing alone decides.
    """

    positions: Float[Tensor, "n 3"]
    colors: Float[Tensor, "n 3"]
    temperatures: Float[Tensor, " n"]
    opacities_rgb: Float[Tensor, " n"]
    opacities_thermal: Float[Tensor, " n"]
    max_scales: Float[Tensor, " n"]

    def rows(self, chosen: Tensor) -> StartPoints:
        """Some of the points."""
        return StartPoints(*(values[chosen] for values in self))


def start_points(scene: Scene, config: TrainConfig) -> StartPoints:
    """The scene's points first, then those far away, as far as the configuration asks for them and
    for temperatures."""
    points = _as_published(scene.points)
    if config.distant_points:
        points = _with_distant(points, scene)
    return _with_temperatures(points, scene) if config.photo_temperatures else points


def _as_published(cloud: PointCloud) -> StartPoints:
    """The scene's points as 3DGS starts from them."""
    like = cloud.positions[:, 0]
    opacities = torch.full_like(like, OPACITY)
    unknown, unlimited = torch.full_like(like, UNSEEN), torch.full_like(like, torch.inf)
    return StartPoints(cloud.positions, cloud.colors, unknown, opacities, opacities, unlimited)


def _with_distant(points: StartPoints, scene: Scene) -> StartPoints:
    """Those far away behind them, in the photos' colours."""
    distant = distant_points(points.positions, scene.train_cameras)
    if len(distant.positions) == 0:
        return points
    positions = torch.cat([points.positions, distant.positions])
    colors = photo_values(positions, _photos(scene, "rgb"), 3)[len(points.positions) :].nan_to_num(
        nan=UNSEEN
    )
    like = distant.positions[:, 0]
    opacities, unknown = torch.full_like(like, DISTANT_OPACITY), torch.full_like(like, UNSEEN)
    sizes = torch.full_like(like, DISTANT_SIZE * distant.spacing)
    added = StartPoints(distant.positions, colors, unknown, opacities, opacities, sizes)
    return StartPoints(*(torch.cat(columns) for columns in zip(points, added, strict=True)))


def _with_temperatures(points: StartPoints, scene: Scene) -> StartPoints:
    """The same where no thermal photo shows a point; where one does, its temperature, and more
    opaque to heat."""
    temperatures = photo_values(points.positions, _photos(scene, "thermal"), 1)[:, 0]
    opaque = points.opacities_thermal.clamp_min(THERMAL_OPACITY)
    return points._replace(
        temperatures=temperatures.nan_to_num(nan=UNSEEN),
        opacities_thermal=torch.where(temperatures.isnan(), points.opacities_thermal, opaque),
    )


def _photos(scene: Scene, modality: str) -> list[PosedImage]:
    photos = [getattr(view, modality) for view in scene.train]
    return [photo for photo in photos if photo is not None]
