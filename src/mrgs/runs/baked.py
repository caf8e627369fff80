"""A trained model as plain splats: what any viewer can draw, without the field.

The temperatures are final where they do not depend on the view; else the part that depends on it is
left out. The colour residual is folded into the spherical harmonics by least squares over the
directions from which the photos were taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from mrgs.field.spherical_harmonics import MAX_DEGREE, evaluate_sh
from mrgs.rasterizer import Layer, rasterize
from mrgs.render import Model, Rendering
from mrgs.scene import Camera, TemperatureRange, spread

COEFFICIENTS = (MAX_DEGREE + 1) ** 2

DIRECTIONS = 32
"""Cameras whose directions are fitted, spread evenly over those of the scene."""

RIDGE = 0.01
"""Weight that keeps the coefficients near the trained ones where the directions do not tell them
apart."""

BLOCK_ROWS = 16_384
"""Gaussians that are fitted at once, to bound the memory."""


@dataclass(frozen=True, eq=False)
class BakedModel:
    """N splats; row i of every tensor belongs to splat i.

    Attributes:
        means: centres in world coordinates (scene units), [N, 3].
        quats: rotations wxyz, unit length, [N, 4].
        scales: standard deviations along the rotated axes, [N, 3].
        opacity_rgb: in (0, 1), [N].
        opacity_thermal: in (0, 1), [N].
        sh: colour coefficients of degrees 0 to 3 as 3DGS has them (colour = max(0, 0.5 + Σ)), [N,
            16, 3].
        temperatures: normalised, [N].
        temperature: the scale of the temperatures; None if the scene has no known °C.
    """

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    opacity_rgb: Float[Tensor, " n"]
    opacity_thermal: Float[Tensor, " n"]
    sh: Float[Tensor, "n 16 3"]
    temperatures: Float[Tensor, " n"]
    temperature: TemperatureRange | None

    def __len__(self) -> int:
        return self.means.shape[0]

    def tensors(self) -> dict[str, Tensor]:
        """What each splat has, by name, in the order of declaration (not copied)."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, Tensor)}

    def subset(self, rows: Int64[Tensor, " k"]) -> BakedModel:
        """Some of the splats, in the order of ``rows``."""
        picked: dict[str, Any] = {name: tensor[rows] for name, tensor in self.tensors().items()}
        return replace(self, **picked)

    @property
    def temperatures_c(self) -> Float[Tensor, " n"]:
        """°C of each splat.

        Raises:
            ValueError: the scene has no known °C.
        """
        if self.temperature is None:
            raise ValueError("the scene has no temperature range, so there is no °C")
        return self.temperature.to_celsius(self.temperatures)

    def colors(self, position: Float[Tensor, "3"]) -> Float[Tensor, "n 3"]:
        """Colour of each splat as seen from a position."""
        directions = torch.nn.functional.normalize(self.means - position, dim=1)
        return (
            evaluate_sh(self.sh[:, :1], self.sh[:, 1:], directions, MAX_DEGREE) + 0.5
        ).clamp_min(0)

    def render(self, camera: Camera) -> Rendering:
        """Both modalities from one camera, without gradients."""
        with torch.no_grad():
            colors = self.colors(camera.position.to(self.means))
            layers = [
                Layer(self.opacity_rgb, colors, colors.new_zeros(3)),
                Layer(self.opacity_thermal, self.temperatures[:, None], colors.new_zeros(1)),
            ]
            raster = rasterize(
                self.means, self.quats, self.scales, layers, camera.viewmat, camera.K,
                camera.width, camera.height,
            )  # fmt: skip
        rgb, thermal = raster.blends
        return Rendering(
            rgb.image, rgb.depth, thermal.image, thermal.depth, rgb.alpha, thermal.alpha
        )


@torch.no_grad()
def bake(
    model: Model, cameras: Sequence[Camera], temperature: TemperatureRange | None
) -> BakedModel:
    """Fold the field of a trained model into plain splats.

    Args:
        model: N Gaussians.
        cameras: of the photos; the colours are fitted for the directions from them.
        temperature: the scale of the thermal values.

    Raises:
        ValueError: no camera.
    """
    if not cameras:
        raise ValueError("colours cannot be fitted without a camera")
    gaussians = model.gaussians
    positions = torch.stack(
        [cameras[index].position for index in spread(len(cameras), DIRECTIONS)]
    ).to(gaussians.means)
    blocks = torch.arange(len(gaussians)).split(BLOCK_ROWS)
    return BakedModel(
        means=gaussians.means.detach(),
        quats=torch.nn.functional.normalize(gaussians.quats, dim=1),
        scales=gaussians.scales,
        opacity_rgb=gaussians.opacity_rgb,
        opacity_thermal=gaussians.opacity_thermal,
        sh=torch.cat([_fit_colors(model, rows, positions) for rows in blocks]),
        temperatures=_temperatures(model),
        temperature=temperature,
    )


def _temperatures(model: Model) -> Float[Tensor, " n"]:
    """t of degree 0, plus t̂; of a model without t̂ clamped at 0, as it is rendered."""
    anywhere = model.gaussians.means.new_zeros(3)
    return model.temperatures(anywhere, sh_degree=0)[:, 0]


def _fit_colors(
    model: Model, rows: Tensor, positions: Float[Tensor, "m 3"]
) -> Float[Tensor, "v 16 3"]:
    """The coefficients whose colours come closest to c + ĉ as seen from the positions, and to the
    trained ones."""
    sh, means = model.gaussians.sh[rows], model.gaussians.means[rows]
    if model.sh_degree < MAX_DEGREE:
        sh = torch.cat(
            [
                sh[:, : (model.sh_degree + 1) ** 2],
                torch.zeros_like(sh[:, (model.sh_degree + 1) ** 2 :]),
            ],
            1,
        )
    if not model.field.config.residuals:
        return sh
    identity = torch.eye(COEFFICIENTS, dtype=sh.dtype).expand(len(rows), -1, -1)
    bases, missing = [], []
    for position in positions:
        directions = torch.nn.functional.normalize(means - position, dim=1)
        basis = evaluate_sh(identity[:, :1], identity[:, 1:], directions, MAX_DEGREE)
        colors = model.field.colors(model.gaussians, position, model.sh_degree, rows)
        bases.append(basis)
        missing.append(colors - 0.5 - torch.einsum("nb,nbc->nc", basis, sh))
    basis, residual = torch.stack(bases, dim=1), torch.stack(missing, dim=1)
    normal = basis.mT @ basis + RIDGE * len(positions) * identity
    return sh + torch.linalg.solve(normal, basis.mT @ residual)
