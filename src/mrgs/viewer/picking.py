"""Read the model at one point of the picture."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.marks.regions import Regions
from mrgs.pictures.files import to_array
from mrgs.pictures.values import in_unit, range_of
from mrgs.rasterizer import Layer, rasterize
from mrgs.render import Model, render
from mrgs.scene import Camera, Modality, Rendering, metric_first
from mrgs.scene.rendering import SOLID_ALPHA
from mrgs.viewer.settings import Subject


@dataclass(frozen=True)
class ValueReading:
    """The value of one modality at a pixel.

    Attributes:
        value: as rendered, in the modality's unit (normalised without one).
        deviation: standard deviation of the values of what makes up the pixel, in the same unit.
    """

    value: float
    deviation: float


@dataclass(frozen=True, eq=False)
class Reading:
    """The model's values at a point.

    Attributes:
        depth: z-depth from the camera that it was read through, scene units.
        depth_deviation: standard deviation of the depths of the splats that make up the pixel,
            scene units.
    """

    position: Float[np.ndarray, "3"]
    depth: float
    depth_deviation: float
    values: Mapping[Modality, ValueReading]


def read_point(
    model: Model,
    camera: Camera,
    u: float,
    v: float,
    subject: Subject,
    regions: Regions | None = None,
) -> Reading | None:
    """Read the pixel under a point of the image; None where the model is empty.

    A value is that of the rendered image. Its deviation is the standard deviation, over all that
    makes up the pixel with its blending weights w_i (the splats, and the background with T_end), of
    their own values; that of the depth is over the splats. It is large where the
    model mixes much, at an edge or where its surface is not thin. It is no error bar against the
    true value.

    Args:
        u: to the right, 0 to 1 over the image.
        v: down, 0 to 1 over the image.
        regions: surfaces with an emissivity of their own; None reads what the photos have.
    """
    column, row = (
        min(int(u * camera.width), camera.width - 1),
        min(int(v * camera.height), camera.height - 1),
    )
    with torch.no_grad():
        rendering = render_surface(model, camera, subject)
        depth = rendering.visible_depth()[row, column].item()
        if not math.isfinite(depth):
            return None
        if regions is not None:
            rendering = regions.applied_to(rendering, camera)
        depth_deviation = _depth_deviation(model, camera, rendering, depth, column, row)
        values = {
            modality: _read_value(model, camera, rendering, modality, subject, column, row)
            for modality in subject.readable
        }
    pixel = torch.tensor([column + 0.5, row + 0.5], dtype=torch.float64)
    position = camera.unproject(pixel, pixel.new_tensor(depth)).numpy()
    return Reading(position, depth, depth_deviation, values)


def render_surface(model: Model, camera: Camera, subject: Subject) -> Rendering:
    """The modalities that are shown, with the depths of their surfaces."""
    with torch.no_grad():
        return render(model, subject.cameras(camera), with_median_depth=True)[0]


def _read_value(
    model: Model,
    camera: Camera,
    rendering: Rendering,
    modality: Modality,
    subject: Subject,
    column: int,
    row: int,
) -> ValueReading:
    """A modality's value at a pixel, and the weighted standard deviation of what makes it up."""
    value = rendering[modality].image[row, column, 0].item()
    own = model.values(modality, camera.position.to(model.gaussians.means))[:, 0]
    squares, beyond = (own - value).square(), value**2
    opacities = model.gaussians.opacity(modality)
    deviation = math.sqrt(_blend(model, camera, opacities, squares, beyond)[row, column])
    low, high = range_of(modality, subject.temperature)
    return ValueReading(in_unit(modality, value, subject.temperature), deviation * (high - low))


def _depth_deviation(
    model: Model, camera: Camera, rendering: Rendering, depth: float, column: int, row: int
) -> float:
    """Weighted standard deviation of the depths of a pixel's splats, in the blend that gives the
    pixel its depth."""
    gaussians, viewmat = model.gaussians, camera.viewmat.to(model.gaussians.means)
    modality = next(  # the pixel has a depth, so one of them covers it
        each
        for each in metric_first(rendering)
        if rendering[each].alpha[row, column] >= SOLID_ALPHA
    )
    alpha, opacities = rendering[modality].alpha, gaussians.opacity(modality)
    squares = (gaussians.means @ viewmat[2, :3] + viewmat[2, 3] - depth).square()
    total = _blend(model, camera, opacities, squares, 0.0)[row, column]
    return math.sqrt(total / alpha[row, column].item())


def _blend(
    model: Model,
    camera: Camera,
    opacities: Float[Tensor, " n"],
    values: Float[Tensor, " n"],
    background: float,
) -> Float[np.ndarray, "h w"]:
    """Σ w_i values_i + T_end · background, at least 0, of every pixel."""
    gaussians = model.gaussians
    layer = Layer(opacities, values[:, None], values.new_full((1,), background))
    raster = rasterize(
        gaussians.means, gaussians.quats, gaussians.scales, [layer], camera.viewmat.to(values),
        camera.K.to(values), camera.width, camera.height, dilation_px2=model.dilation.of(camera),
    )  # fmt: skip
    return to_array(raster.blends[0].image[..., 0].clamp_min(0))
