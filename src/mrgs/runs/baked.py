"""A trained model as plain splats, which any viewer can draw without the field: temperatures as far
as they do not depend on the view, and the colour residual folded into the spherical harmonics by
least squares over the directions of the photos."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from mrgs.field.spherical_harmonics import C0, MAX_DEGREE, evaluate_sh, shade, up_to_degree
from mrgs.rasterizer import Geometry, median_depth, rasterize
from mrgs.rasterizer.contract import Dilation
from mrgs.render import Model, blends_of, layer_of, shared_passes
from mrgs.runs.trained_run import asked_cameras
from mrgs.scene import (
    RGB,
    THERMAL,
    Blend,
    Camera,
    Modality,
    Rendering,
    TemperatureRange,
    evenly_spaced,
)
from mrgs.scene.radiometry import BandRadiance
from mrgs.system.gpu import HOST
from mrgs.system.torch_modes import own_modes

COEFFICIENTS = (MAX_DEGREE + 1) ** 2

DIRECTIONS = 32
"""Cameras whose directions are fitted, spread evenly over those of the scene."""

RIDGE = 0.01
"""Weight towards the trained coefficients where the directions do not tell them apart."""

BLOCK_ROWS = 16_384
"""Gaussians that are fitted at once, to bound the memory."""


@dataclass(frozen=True, eq=False)
class BakedModel:
    """N splats; row i of every tensor belongs to splat i.

    Attributes:
        means: centres in world coordinates (scene units), [N, 3].
        quats: rotations wxyz, unit length, [N, 4].
        scales: standard deviations along the rotated axes, [N, 3].
        opacities: of each modality, in (0, 1), [N].
        sh_dc: coefficient of degree 0 of each modality of C channels but the thermal one, as 3DGS
            has them (value = max(0, 0.5 + Σ)), [N, 1, C].
        sh_rest: coefficients of the higher degrees, [N, B, C]; B is 15 where a modality depends on
            the view up to degree 3.
        temperatures: normalised, [N].
        temperature: the scale of the temperatures; None if the scene has no known °C.
        dilation: of the projected covariances.
        radiance: in which temperatures are blended; None to blend them as they are.
        device: where the splats are rendered; they and the images are in the host's memory.
    """

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    opacities: Mapping[Modality, Float[Tensor, " n"]]
    sh_dc: Mapping[Modality, Float[Tensor, "n 1 _"]]
    sh_rest: Mapping[Modality, Float[Tensor, "n _ _"]]
    temperatures: Float[Tensor, " n"]
    temperature: TemperatureRange | None
    _: KW_ONLY
    dilation: Dilation
    radiance: BandRadiance | None = None
    device: torch.device = HOST

    @cached_property
    def _rendered(self) -> BakedModel:
        """The splats where they are rendered."""
        return self.map_tensors(lambda tensor: tensor.to(self.device))

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def modalities(self) -> tuple[Modality, ...]:
        """Modalities that the model renders, RGB first."""
        return tuple(self.opacities)

    def tensors(self) -> dict[str, Tensor]:
        """What each splat has, by name, in the order of declaration (not copied)."""
        return {
            "means": self.means,
            "quats": self.quats,
            "scales": self.scales,
            **{f"opacity.{modality}": each for modality, each in self.opacities.items()},
            **{f"sh_dc.{modality}": each for modality, each in self.sh_dc.items()},
            **{f"sh_rest.{modality}": each for modality, each in self.sh_rest.items()},
            "temperatures": self.temperatures,
        }

    def subset(self, rows: Int64[Tensor, " k"]) -> BakedModel:
        """Some of the splats, in the order of ``rows``."""
        return self.map_tensors(lambda tensor: tensor[rows])

    def only(self, modalities: Container[Modality]) -> BakedModel:
        """The same splats with some of the modalities."""
        chosen: dict[str, Any] = {
            name: {each: value for each, value in values.items() if each in modalities}
            for name, values in vars(self).items()
            if isinstance(values, Mapping)
        }
        return replace(self, **chosen)

    def map_tensors(self, function: Callable[[Tensor], Tensor]) -> BakedModel:
        """A copy of the model with a function applied to each of its tensors."""
        changed: dict[str, Any] = {}
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                changed[name] = function(value)
            elif isinstance(value, Mapping):
                changed[name] = {modality: function(each) for modality, each in value.items()}
        return replace(self, **changed)

    def sh(self, modality: Modality) -> Float[Tensor, "n b c"]:
        """All coefficients of a modality, copied."""
        return torch.cat([self.sh_dc[modality], self.sh_rest[modality]], dim=1)

    def base_values(self, modality: Modality) -> Float[Tensor, "n c"]:
        """The part of each splat's values that does not depend on the view, normalised, [N, C]: the
        temperatures, or the harmonics of degree 0."""
        if modality == THERMAL:
            return self.temperatures[:, None]
        return 0.5 + C0 * self.sh_dc[modality][:, 0]

    def values(self, modality: Modality, position: Float[Tensor, "3"]) -> Float[Tensor, "n c"]:
        """What is blended, seen from a position: colours of RGB, or normalised temperatures."""
        if modality == THERMAL:
            return self.temperatures[:, None]
        dc, rest = self.sh_dc[modality], self.sh_rest[modality]
        shaded: Tensor = shade(self.means, dc, rest, position.to(self.means), MAX_DEGREE)
        return shaded

    def render(
        self, cameras: Camera | Mapping[Modality, Camera], surface: Modality | None = None
    ) -> Rendering:
        """Render any camera, or one for each modality to render, without gradients, and the median
        depth of a modality ``surface``. ValueError if ``cameras`` is something else."""
        cameras = asked_cameras(cameras, self.modalities)
        with torch.no_grad(), own_modes(self.device):
            blends = self._rendered._blend(cameras).cpu()
            if surface is None:
                return blends
            return Rendering(dict(blends), {surface: self.median_depth(surface, cameras[surface])})

    def median_depth(self, modality: Modality, camera: Camera) -> Float[Tensor, "h w"]:
        """The z-depth at which half of a modality's light is blocked; NaN where less is."""
        with own_modes():  # on the host, where it is found in any case
            projection = self.dilation.projection(camera, self.means.device)
            return median_depth(self._geometry, self.opacities[modality], projection).cpu()

    @property
    def _geometry(self) -> Geometry:
        return Geometry(self.means, self.quats, self.scales)

    def _blend(self, cameras: Mapping[Modality, Camera]) -> Rendering:
        """The modalities' values, each blended with its opacities, before black."""
        blends: dict[Modality, Blend] = {}
        for camera, modalities in shared_passes(cameras):
            projection = self.dilation.projection(camera, self.device)
            values = [self.values(each, cameras[each].position) for each in modalities]
            layers = [
                layer_of(each, self.opacities[each], own, self.radiance)
                for each, own in zip(modalities, values, strict=True)
            ]
            raster = rasterize(self._geometry, layers, projection)
            blends |= blends_of(raster, modalities, self.radiance)
        return Rendering({modality: blends[modality] for modality in cameras})


@torch.no_grad()
def bake(
    model: Model,
    cameras: Sequence[Camera],
    temperature: TemperatureRange | None,
    device: torch.device = HOST,
) -> BakedModel:
    """Fold the field of a trained model into plain splats, to be rendered on a device, with colours
    that are fitted for the directions from the photos' cameras. What the field does not change is
    shared, not copied. ValueError without a camera."""
    if not cameras:
        raise ValueError("colours cannot be fitted without a camera")
    gaussians = model.gaussians
    positions = torch.stack(
        [cameras[index].position for index in evenly_spaced(len(cameras), DIRECTIONS)]
    ).to(gaussians.means)
    harmonics = {
        modality: _harmonics(model, modality, positions)
        for modality in gaussians.modalities
        if modality != THERMAL
    }
    # t of degree 0, plus t̂, clamped as it is rendered.
    temperatures = model.values(THERMAL, gaussians.means.new_zeros(3), sh_degree=0)[:, 0]
    return BakedModel(
        means=gaussians.means.detach(),
        quats=torch.nn.functional.normalize(gaussians.quats, dim=1),
        scales=gaussians.scales,
        opacities={modality: gaussians.opacity(modality) for modality in gaussians.modalities},
        sh_dc={modality: dc for modality, (dc, _) in harmonics.items()},
        sh_rest={modality: rest for modality, (_, rest) in harmonics.items()},
        temperatures=temperatures,
        temperature=temperature,
        dilation=model.dilation,
        radiance=model.radiance,
        device=device,
    )


def _harmonics(
    model: Model, modality: Modality, positions: Float[Tensor, "m 3"]
) -> tuple[Float[Tensor, "n 1 c"], Float[Tensor, "n b c"]]:
    """A modality's coefficients of degree 0 and of the higher degrees, those that are not in use
    zero, with the colour residual ĉ folded in."""
    gaussians = model.gaussians
    dc = gaussians.sh_dc[modality].detach()
    rest = up_to_degree(gaussians.sh_rest[modality].detach(), model.sh_degree)
    if modality != RGB or not model.field.config.residuals:
        return dc, rest
    sh = torch.cat([dc, rest], dim=1)
    blocks = torch.arange(len(dc)).split(BLOCK_ROWS)
    fitted = torch.cat([_fit_colors(model, sh[rows], rows, positions) for rows in blocks])
    return fitted[:, :1], fitted[:, 1:]


def _fit_colors(
    model: Model,
    sh: Float[Tensor, "v 16 3"],
    rows: Int64[Tensor, " v"],
    positions: Float[Tensor, "m 3"],
) -> Float[Tensor, "v 16 3"]:
    """The coefficients closest to c + ĉ as seen from the positions, and to the trained ones."""
    means = model.gaussians.means[rows]
    identity = torch.eye(COEFFICIENTS, dtype=sh.dtype).expand(len(rows), -1, -1)
    bases, missing = [], []
    for position in positions:
        directions = torch.nn.functional.normalize(means - position, dim=1)
        basis = evaluate_sh(identity[:, :1], identity[:, 1:], directions, MAX_DEGREE)
        colors = model.values(RGB, position, rows)
        bases.append(basis)
        missing.append(colors - 0.5 - torch.einsum("nb,nbc->nc", basis, sh))
    basis, residual = torch.stack(bases, dim=1), torch.stack(missing, dim=1)
    normal = basis.mT @ basis + RIDGE * len(positions) * identity
    return sh + torch.linalg.solve(normal, basis.mT @ residual)
