"""Read the model: one point of the picture, or all that is seen in a box."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.pictures.files import to_array
from mrgs.rasterizer import Layer, rasterize
from mrgs.render import Model, render
from mrgs.scene import RGB, THERMAL, Camera, Rendering
from mrgs.viewer.fields import SOLID_ALPHA, surface_depth
from mrgs.viewer.settings import Subject


@dataclass(frozen=True, eq=False)
class Reading:
    """What the model has at a point.

    Attributes:
        position: in world coordinates, [3].
        depth: z-depth from the camera that it was read through, scene units.
        depth_spread: standard deviation of the depths of the splats that make up the pixel, scene
            units.
        value: temperature as rendered, °C (normalised without °C); None for a model without
            temperatures.
        value_spread: standard deviation of the temperatures of what makes up the pixel, in the same
            unit.
    """

    position: Float[np.ndarray, "3"]
    depth: float
    depth_spread: float
    value: float | None
    value_spread: float | None


@dataclass(frozen=True)
class Extreme:
    """The place of a minimum or maximum: u to the right and v down, 0 to 1 over the image, and its
    value."""

    u: float
    v: float
    value: float


@dataclass(frozen=True)
class BoxReading:
    """What is seen in a box: its coldest and hottest pixel, the mean, and how many pixels were
    counted."""

    lowest: Extreme
    mean: float
    highest: Extreme
    pixels: int


@dataclass(frozen=True)
class Box:
    """A rectangle of an image: u to the right and v down, 0 to 1 over the image."""

    u0: float
    v0: float
    u1: float
    v1: float


def read_point(
    model: Model, camera: Camera, u: float, v: float, subject: Subject
) -> Reading | None:
    """Read the pixel under a point of the image; None where the model is empty.

    The value is that of the rendered image. The spread is the standard deviation, over all that
    makes up the pixel with its blending weights w_i (the splats, and the background with T_end), of
    their own temperatures; that of the depth is over the splats. It says how much the model mixes
    there, at an edge or where its surface is not thin. It is no error bar against the true
    temperature.

    Args:
        model: to render.
        camera: the image's; its size is that of the rendering.
        u: to the right, 0 to 1 over the image.
        v: down, 0 to 1 over the image.
        subject: says what the model has.
    """
    column, row = (
        min(int(u * camera.width), camera.width - 1),
        min(int(v * camera.height), camera.height - 1),
    )
    with torch.no_grad():
        rendering, _ = render(model, subject.cameras(camera))
        depth = surface_depth(rendering)[row, column].item()
        if not math.isfinite(depth):
            return None
        depth_spread = _depth_spread(model, camera, rendering, depth, column, row)
        value = spread = None
        if THERMAL in rendering:
            value = rendering[THERMAL].image[row, column, 0].item()
            own = model.values(THERMAL, camera.position.to(model.gaussians.means))[:, 0]
            squares = (own - value).square()
            beyond = value**2
            opacities = model.gaussians.opacity(THERMAL)
            spread = math.sqrt(_blend(model, camera, opacities, squares, beyond)[row, column])
    if value is not None and spread is not None and subject.temperature is not None:
        value, spread = subject.temperature.to_celsius(value), spread * subject.temperature.span_c
    pixel = torch.tensor([column + 0.5, row + 0.5], dtype=torch.float64)
    position = camera.unproject(pixel, pixel.new_tensor(depth)).numpy()
    return Reading(position, depth, depth_spread, value, spread)


def _depth_spread(
    model: Model, camera: Camera, rendering: Rendering, depth: float, column: int, row: int
) -> float:
    """Weighted standard deviation of the depths of a pixel's splats, in the blend that gives the
    pixel its depth."""
    gaussians, viewmat = model.gaussians, camera.viewmat.to(model.gaussians.means)
    covering = [
        modality
        for modality in (THERMAL, RGB)
        if modality in rendering and rendering[modality].alpha[row, column] >= SOLID_ALPHA
    ]
    modality = covering[0]  # the pixel has a depth, so one of them covers it
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
        camera.K.to(values), camera.width, camera.height,
    )  # fmt: skip
    return to_array(raster.blends[0].image[..., 0].clamp_min(0))


def read_box(
    values: Float[np.ndarray, "h w"], solid: Bool[np.ndarray, "h w"], box: Box
) -> BoxReading | None:
    """Minimum, mean and maximum of the pixels of a box that are solid and not NaN; None if there
    are none."""
    height, width = values.shape
    left, right = sorted(
        (int(np.clip(box.u0, 0, 1) * width), int(np.ceil(np.clip(box.u1, 0, 1) * width)))
    )
    top, bottom = sorted(
        (int(np.clip(box.v0, 0, 1) * height), int(np.ceil(np.clip(box.v1, 0, 1) * height)))
    )
    inside = values[top:bottom, left:right]
    counted = solid[top:bottom, left:right] & np.isfinite(inside)
    if not counted.any():
        return None

    def extreme(index: np.intp) -> Extreme:
        row, column = np.unravel_index(index, inside.shape)
        return Extreme(
            (left + float(column) + 0.5) / width,
            (top + float(row) + 0.5) / height,
            float(inside[row, column]),
        )

    return BoxReading(
        extreme(np.where(counted, inside, np.inf).argmin()),
        float(inside[counted].mean(dtype=np.float64)),
        extreme(np.where(counted, inside, -np.inf).argmax()),
        int(counted.sum()),
    )
