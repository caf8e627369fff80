"""Model and camera in, images out: the field gives the values, the rasterizer blends them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import KW_ONLY, dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from mrgs.field import RadianceField
from mrgs.rasterizer import Geometry, Layer, Raster, contract, median_depth, rasterize
from mrgs.rasterizer.contract import Dilation
from mrgs.rasterizer.pose_gradient import with_pose_gradient
from mrgs.scene import RGB, THERMAL, Blend, Camera, Gaussians, Modality, Rendering
from mrgs.scene.radiometry import BandRadiance

ALL_ROWS_FROM = 0.9
"""Above this share in view, picking rows costs more than evaluating the heads for the others."""


@dataclass
class Model:
    """Everything that an image is rendered from.

    Attributes:
        field: what turns their parameters into colours and temperatures.
        neighbours: of each Gaussian, for the heat transformation, [N, K]; None if the field has
            none.
        sh_degree: highest degree of the spherical harmonics in use, 0 to 3.
        temperature_residuals: t̂ of each Gaussian, [N, 1], where it is known beforehand
            (``bake_temperature_residuals``); else None.
        dilation: of the projected covariances.
        radiance: in which temperatures are blended, as a camera's pixels average them; None to
            blend temperatures, as published.
    """

    gaussians: Gaussians
    field: RadianceField
    neighbours: Int64[Tensor, "n k"] | None
    sh_degree: int = 3
    temperature_residuals: Float[Tensor, "n 1"] | None = None
    _: KW_ONLY
    dilation: Dilation
    radiance: BandRadiance | None = None

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

    def values(
        self,
        modality: Modality,
        camera_position: Float[Tensor, "3"],
        rows: Int64[Tensor, " v"] | None = None,
        *,
        sh_degree: int | None = None,
    ) -> Float[Tensor, "v c"]:
        """What is blended of a modality, as seen from a position: c + ĉ of RGB, t + t̂ of thermal
        (normalised), spherical harmonics of any other.

        Args:
            modality: one that the Gaussians have.
            camera_position: in world coordinates.
            rows: of the Gaussians; all if None.
            sh_degree: highest degree of the spherical harmonics that counts; the model's if None.
        """
        degree = self.sh_degree if sh_degree is None else sh_degree
        if modality == RGB:
            return self.field.colors(self.gaussians, camera_position, degree, rows)
        if modality == THERMAL:
            return self.field.temperatures(
                self.gaussians,
                self.neighbours,
                camera_position,
                degree,
                rows,
                residuals=self.temperature_residuals,
                color_degree=self.sh_degree,
            )
        return self.field.intensities(modality, self.gaussians, camera_position, degree, rows)

    @torch.no_grad()
    def median_depth(self, modality: Modality, camera: Camera) -> Float[Tensor, "h w"]:
        """The z-depth where half of a modality's light is blocked, else NaN; without gradient."""
        gaussians = self.gaussians
        return median_depth(
            Geometry.of(gaussians),
            gaussians.opacity(modality),
            self.dilation.projection(camera, gaussians.means.device),
        )


class ScreenPoints(NamedTuple):
    """The projected centres of one pass, for densification: an ``offset`` of zeros, whose gradient
    after the backward pass is that of the centres, in 1/px; radii, 0 where the pass does not draw
    the Gaussian; and width and height of the image in pixels."""

    offset: Float[Tensor, "n 2"]
    radii: Float[Tensor, " n"]
    size: tuple[int, int]


def bake_temperature_residuals(model: Model) -> Model:
    """The same model with t̂ computed once for all views; for models that are no longer trained."""
    if not model.field.config.residuals:
        return model
    with torch.no_grad():
        residuals = model.field.temperature_residuals(
            model.gaussians, model.neighbours, color_degree=model.sh_degree
        )
    return replace(model, temperature_residuals=residuals)


def render(
    model: Model,
    cameras: Mapping[Modality, Camera],
    sh_degrees: Mapping[Modality, int] | None = None,
    *,
    with_median_depth: bool = False,
) -> tuple[Rendering, list[ScreenPoints]]:
    """Render each modality from its camera; modalities that one fused pass can serve share it.

    Differentiable in the Gaussians' parameters and the field's. Returns the images, and the
    projected centres of each pass.

    Args:
        sh_degrees: highest degree of a modality's spherical harmonics that counts; the model's for
            those that are not named.
        with_median_depth: also find the depth of the surface, which carries no gradient.
    """
    degrees = sh_degrees or {}
    blends: dict[Modality, Blend] = {}
    depths: dict[Modality, Tensor] = {}
    points = []
    for camera, modalities in shared_passes(cameras):
        rows = rows_in_view(model, camera)
        layers = [_layer(model, each, camera, rows, degrees.get(each)) for each in modalities]
        raster, projected = _pass(model, layers, camera)
        blends |= blends_of(raster, modalities, model.radiance)
        if with_median_depth:
            depths |= {each: model.median_depth(each, camera) for each in modalities}
        points.append(projected)
    return Rendering({modality: blends[modality] for modality in cameras}, depths), points


def renderer(
    model: Model, sh_degrees: Mapping[Modality, int] | None = None
) -> Callable[[Mapping[Modality, Camera]], Rendering]:
    """The images of ``render`` as a function of the cameras alone, differentiable as there."""
    return lambda cameras: render(model, cameras, sh_degrees)[0]


def shared_passes(cameras: Mapping[Modality, Camera]) -> list[tuple[Camera, list[Modality]]]:
    """Modalities that are rendered together: with coinciding cameras, one of three channels and one
    of one, as the fused pass takes them; any other has a pass of its own."""
    passes: list[tuple[Camera, list[Modality]]] = []
    for modality, camera in cameras.items():
        for other, together in passes:
            channels = [modality.channels, *(each.channels for each in together)]
            if camera.coincides_with(other) and sorted(channels) == [1, 3]:
                together.append(modality)
                break
        else:
            passes.append((camera, [modality]))
    return passes


def layer_of(
    modality: Modality,
    opacities: Float[Tensor, " n"],
    values: Float[Tensor, "n c"],
    radiance: BandRadiance | None,
) -> Layer:
    """A modality to blend before black, the value 0; temperatures as radiance if they have one."""
    if modality == THERMAL and radiance is not None:
        values = radiance.of_value(values)
    return Layer(opacities, values, values.new_zeros(modality.channels))


def blends_of(
    raster: Raster, modalities: Sequence[Modality], radiance: BandRadiance | None
) -> dict[Modality, Blend]:
    """What the rasterizer made of the layers of ``layer_of``, as values of the modalities."""
    blends = dict(zip(modalities, raster.blends, strict=True))
    if THERMAL in blends and radiance is not None:
        thermal = blends[THERMAL]
        blends[THERMAL] = thermal._replace(image=radiance.to_value(thermal.image))
    return blends


def _layer(
    model: Model,
    modality: Modality,
    camera: Camera,
    rows: Int64[Tensor, " v"] | None,
    sh_degree: int | None,
) -> Layer:
    """A modality of a model, as seen from a camera."""
    gaussians = model.gaussians
    position = camera.tensors(gaussians.means.device, gaussians.means.dtype).position
    values = model.values(modality, position, rows, sh_degree=sh_degree)
    layer = layer_of(modality, gaussians.opacity(modality), values, model.radiance)
    if rows is None:
        return layer
    zeros = values.new_zeros(len(gaussians), modality.channels)
    return layer._replace(features=zeros.index_copy(0, rows, layer.features))


@torch.no_grad()
def rows_in_view(model: Model, camera: Camera) -> Int64[Tensor, " v"] | None:
    """The Gaussians that the rasterizer's kernel may draw, so that the heads need not be evaluated
    for others; None for all. The kernel's bound on the covariance, for the largest scale, leaves
    out no Gaussian that is drawn. It is all where the plain definition runs, whose falloff may have
    been edited, and on a GPU, where waiting for their number costs more than the heads."""
    means = model.gaussians.means
    kernel = rasterize.kernel((means,))
    if not means.is_cpu or kernel is None or kernel in rasterize.rejected:
        return None
    K, viewmat, _ = camera.tensors(means.device, means.dtype)
    # Rows of x, y and z: strides of three would keep torch from its vectors.
    x, y, z = torch.addmm(viewmat[:3, 3:], viewmat[:3, :3], means.T)
    largest = model.gaussians.log_scales.amax(dim=1).exp()
    in_view = z >= contract.NEAR_PLANE
    dilation = model.dilation.of(camera)
    for across, focal, centre, size in (
        (x, K[0, 0], K[0, 2], camera.width),
        (y, K[1, 1], K[1, 2], camera.height),
    ):
        slope = across / z
        margin = contract.FRUSTUM_MARGIN * 0.5 * size / focal
        clamped = slope.clamp(-centre / focal - margin, (size - centre) / focal + margin)
        variance = (largest * focal / z) ** 2 * (1 + clamped**2) + dilation
        extent = (2 * math.log(1 / contract.ALPHA_MIN) * variance).sqrt()
        place = focal * slope + centre
        in_view &= (place + extent >= 0) & (place - extent <= size)
    rows = torch.from_numpy(np.flatnonzero(in_view.numpy()))
    return None if len(rows) > ALL_ROWS_FROM * len(means) else rows


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
    viewmat = camera.tensors(means.device).viewmat
    moved = with_pose_gradient(means, gaussians.quats, viewmat)
    projection = model.dilation.projection(camera, means.device)
    raster = rasterize(Geometry(*moved, gaussians.scales), layers, projection, offset)
    return raster, ScreenPoints(offset, raster.radii, (camera.width, camera.height))
