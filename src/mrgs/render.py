"""A model and a camera in, images out: the field gives colours and temperatures, the rasterizer
blends them."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, NamedTuple, TypeAlias

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from mrgs.field import RadianceField
from mrgs.rasterizer import Blend, Layer, Raster, contract, rasterize
from mrgs.scene import Camera, Gaussians, View

ALL_ROWS_FROM = 0.9
"""Above this share in view, picking rows costs more than evaluating the heads for the others."""


@dataclass
class Model:
    """Everything that an image is rendered from.

    Attributes:
        gaussians: the shared Gaussians.
        field: what turns their parameters into colours and temperatures.
        neighbours: of each Gaussian, for the heat transformation, [N, K]; None if the field has
            none.
        sh_degree: highest degree of the spherical harmonics in use, 0 to 3.
        temperature_residuals: t̂ of each Gaussian, [N, 1], where it is known beforehand
            (``bake_temperature_residuals``); else None.
    """

    gaussians: Gaussians
    field: RadianceField
    neighbours: Int64[Tensor, "n k"] | None
    sh_degree: int = 3
    temperature_residuals: Float[Tensor, "n 1"] | None = None

    def to(self, device: torch.device) -> Model:
        """The same model on a device, to render with; itself if it is there."""
        if self.gaussians.means.device == device:
            return self
        residuals = self.temperature_residuals
        return replace(
            self,
            gaussians=self.gaussians.to(device),
            field=deepcopy(self.field).to(device),
            neighbours=None if self.neighbours is None else self.neighbours.to(device),
            temperature_residuals=None if residuals is None else residuals.to(device),
        )

    def temperatures(
        self,
        camera_position: Float[Tensor, "3"],
        rows: Int64[Tensor, " v"] | None = None,
        *,
        sh_degree: int | None = None,
    ) -> Float[Tensor, "v 1"]:
        """t + t̂, normalised, as seen from a position.

        Args:
            camera_position: in world coordinates.
            rows: of the Gaussians; all if None.
            sh_degree: highest degree of t's harmonics that counts; the model's if None.
        """
        degree = self.sh_degree if sh_degree is None else sh_degree
        return self.field.temperatures(
            self.gaussians,
            self.neighbours,
            camera_position,
            degree,
            rows,
            self.temperature_residuals,
        )


class Rendering(NamedTuple):
    """What a model shows from one view; None for a modality without a camera.

    Attributes:
        rgb: colours from the RGB camera, not clamped, [H, W, 3].
        depth_rgb: z-depth of the same camera blended with o_c, scene units, [H, W].
        thermal: normalised temperature from the thermal camera, not clamped, [H', W', 1].
        depth_thermal: its z-depth blended with o_t, [H', W'].
        alpha_rgb: accumulated alpha of the RGB blend, [H, W].
        alpha_thermal: of the thermal blend, [H', W'].
    """

    rgb: Float[Tensor, "h w 3"] | None = None
    depth_rgb: Float[Tensor, "h w"] | None = None
    thermal: Float[Tensor, "h2 w2 1"] | None = None
    depth_thermal: Float[Tensor, "h2 w2"] | None = None
    alpha_rgb: Float[Tensor, "h w"] | None = None
    alpha_thermal: Float[Tensor, "h2 w2"] | None = None

    def cpu(self) -> Rendering:
        """The images in the host's memory."""
        return Rendering(*(None if image is None else image.cpu() for image in self))

    def surface_depth(
        self,
        modality: Literal["rgb", "thermal"],
        min_alpha: float = 0.5,
        max_step: float | None = None,
    ) -> Float[Tensor, "h3 w3"]:
        """z-depth of the surface that a pixel shows, D / A: the blended depth without the share of
        the background.

        Args:
            modality: whose blend; it must have been rendered.
            min_alpha: a pixel that is covered less shows no surface.
            max_step: largest difference of depth within 3×3 pixels, as a share of the pixel's; one
                of more lies on an outline, where the mean depth is that of neither surface. None to
                keep outlines.

        Returns:
            Scene units, NaN where there is no surface, the image's size.
        """
        depth, alpha = (
            (self.depth_rgb, self.alpha_rgb)
            if modality == "rgb"
            else (self.depth_thermal, self.alpha_thermal)
        )
        assert depth is not None
        assert alpha is not None
        surface = torch.where(alpha >= min_alpha, depth / alpha.clamp_min(min_alpha), torch.nan)
        if max_step is None:
            return surface
        return torch.where(_depth_range(surface) > max_step * surface, torch.nan, surface)


Photograph: TypeAlias = Callable[[Rendering, Camera], Rendering]
"""From what is there, and the camera that it is seen from, to what the scene's cameras would have
written there."""


def as_it_is(rendering: Rendering, camera: Camera) -> Rendering:
    """Cameras that change nothing."""
    return rendering


class ScreenPoints(NamedTuple):
    """The projected centres of one pass, for densification.

    Attributes:
        offset: zeros, [N, 2]; after the backward pass its gradient is that of the projected
            centres, in 1/px.
        radii: [N], 0 where the pass does not draw the Gaussian.
        size: width and height of the image in pixels.
    """

    offset: Float[Tensor, "n 2"]
    radii: Float[Tensor, " n"]
    size: tuple[int, int]


def bake_temperature_residuals(model: Model) -> Model:
    """The same model with t̂ computed once for all views; for models that are no longer trained."""
    if not model.field.config.residuals:
        return model
    with torch.no_grad():
        residuals = model.field.temperature_residuals(model.gaussians, model.neighbours)
    return replace(model, temperature_residuals=residuals)


def render_view(model: Model, view: View) -> Rendering:
    """Render a view from its own cameras; no gradients are kept."""
    rgb_camera = view.rgb.camera if view.rgb else None
    thermal_camera = view.thermal.camera if view.thermal else None
    with torch.no_grad():
        return render(model, rgb_camera, thermal_camera)[0]


def render(
    model: Model,
    rgb_camera: Camera | None,
    thermal_camera: Camera | None,
    temperature_sh_degree: int | None = None,
) -> tuple[Rendering, list[ScreenPoints]]:
    """Render the modalities that have a camera: in one fused pass if both cameras coincide, else in
    one pass each.

    Differentiable in the Gaussians' parameters and the field's.

    Args:
        model: what to render.
        rgb_camera: of the RGB image.
        thermal_camera: of the thermal image.
        temperature_sh_degree: highest degree of the temperatures' harmonics that counts; the
            model's if None.

    Returns:
        the images, and the projected centres of each pass.
    """
    thermal_layer = partial(_thermal_layer, sh_degree=temperature_sh_degree)
    if (
        rgb_camera is not None
        and thermal_camera is not None
        and rgb_camera.coincides_with(thermal_camera)
    ):
        rows = rows_in_view(model.gaussians, rgb_camera)
        layers = [_rgb_layer(model, rgb_camera, rows), thermal_layer(model, rgb_camera, rows)]
        raster, points = _pass(model, layers, rgb_camera)
        return _rendering(*raster.blends), [points]
    blends: list[Blend | None] = []
    passes = []
    for camera, make_layer in ((rgb_camera, _rgb_layer), (thermal_camera, thermal_layer)):
        if camera is None:
            blends.append(None)
            continue
        rows = rows_in_view(model.gaussians, camera)
        raster, points = _pass(model, [make_layer(model, camera, rows)], camera)
        blends.append(raster.blends[0])
        passes.append(points)
    return _rendering(*blends), passes


def _depth_range(depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Largest minus smallest depth within 3×3 pixels; NaN does not count."""
    far, minus_near = (
        torch.nn.functional.max_pool2d(
            signed.nan_to_num(nan=-torch.inf)[None], 3, stride=1, padding=1
        )[0]
        for signed in (depth, -depth)
    )
    return far + minus_near


def _rendering(rgb: Blend | None, thermal: Blend | None) -> Rendering:
    color = (None, None, None) if rgb is None else rgb
    heat = (None, None, None) if thermal is None else thermal
    return Rendering(color[0], color[1], heat[0], heat[1], color[2], heat[2])


def _rgb_layer(model: Model, camera: Camera, rows: Int64[Tensor, " v"] | None) -> Layer:
    """o_c and c + ĉ."""
    gaussians = model.gaussians
    colors = model.field.colors(
        gaussians, _position(camera, gaussians.means), model.sh_degree, rows
    )
    return Layer(
        gaussians.opacity_rgb,
        _scatter(colors, rows, len(gaussians)),
        colors.new_zeros(3),
    )


def _thermal_layer(
    model: Model, camera: Camera, rows: Int64[Tensor, " v"] | None, sh_degree: int | None
) -> Layer:
    """o_t and t + t̂."""
    gaussians = model.gaussians
    values = model.temperatures(_position(camera, gaussians.means), rows, sh_degree=sh_degree)
    return Layer(
        gaussians.opacity_thermal,
        _scatter(values, rows, len(gaussians)),
        values.new_zeros(1),
    )


def _position(camera: Camera, means: Float[Tensor, "n 3"]) -> Float[Tensor, "3"]:
    """The centre of projection, where the Gaussians are."""
    return camera.tensors(means.device, means.dtype).position


@torch.no_grad()
def rows_in_view(gaussians: Gaussians, camera: Camera) -> Int64[Tensor, " v"] | None:
    """The Gaussians that the rasterizer may draw, so that the heads need not be evaluated for
    others; None for all.

    Bounds the projected covariance by the largest scale, so no Gaussian that is drawn is left out.
    On a GPU it is all: the host would have to wait for their number, which costs more than the
    heads of those that are not seen.
    """
    means = gaussians.means
    if not means.is_cpu:
        return None
    K, viewmat, _ = camera.tensors(means.device, means.dtype)
    x, y, z = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(dim=1)
    largest = gaussians.log_scales.max(dim=1).values.exp()
    in_view = z >= contract.NEAR_PLANE
    for across, focal, centre, size in (
        (x, K[0, 0], K[0, 2], camera.width),
        (y, K[1, 1], K[1, 2], camera.height),
    ):
        slope = across / z
        margin = contract.FRUSTUM_MARGIN * 0.5 * size / focal
        clamped = slope.clamp(-centre / focal - margin, (size - centre) / focal + margin)
        variance = (largest * focal / z) ** 2 * (1 + clamped**2) + contract.COVARIANCE_DILATION_PX2
        extent = (2 * math.log(1 / contract.ALPHA_MIN) * variance).sqrt()
        place = focal * slope + centre
        in_view &= (place + extent >= 0) & (place - extent <= size)
    rows = in_view.nonzero()[:, 0]
    return None if len(rows) > ALL_ROWS_FROM * len(means) else rows


def _scatter(
    values: Float[Tensor, "v c"], rows: Int64[Tensor, " v"] | None, count: int
) -> Float[Tensor, "n c"]:
    """Values of some rows among zeros for the others."""
    if rows is None:
        return values
    return values.new_zeros(count, values.shape[1]).index_copy(0, rows, values)


def _pass(model: Model, layers: list[Layer], camera: Camera) -> tuple[Raster, ScreenPoints]:
    gaussians = model.gaussians
    means = gaussians.means
    offset = torch.zeros(
        len(gaussians),
        2,
        dtype=means.dtype,
        device=means.device,
        requires_grad=torch.is_grad_enabled(),
    )
    K, viewmat, _ = camera.tensors(means.device)
    raster = rasterize(
        means,
        gaussians.quats,
        gaussians.scales,
        layers,
        viewmat,
        K,
        camera.width,
        camera.height,
        offset,
    )
    return raster, ScreenPoints(offset, raster.radii, (camera.width, camera.height))
