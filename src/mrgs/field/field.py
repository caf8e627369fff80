"""The radiance field: colour and temperature of each Gaussian, as the rasterizer blends them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from mrgs.errors import ConfigError
from mrgs.field.appearance import ColorHead, OrthogonalExtraction, ThermalFeatureHead
from mrgs.field.encoding import fourier_embedding, position_frame
from mrgs.field.heat import FourierHeatTransformation
from mrgs.field.spherical_harmonics import C0, evaluate_sh
from mrgs.scene.gaussians import Gaussians

MAX_NEIGHBOURS_N = 16
"""255 neighbours of each Gaussian; the paper stops at 48."""


@dataclass(frozen=True)
class FieldConfig:
    """What stands between the Gaussians' parameters and the values that are blended.

    Attributes:
        residuals: add the learned residuals ĉ and t̂; off for 3DGS_RGB-T, which blends spherical harmonics alone.
        fourier: let neighbours exchange heat (the Fourier heat transformation).
        embedding_width: C of the multi-modal embedding e_m; a multiple of 6.
        direction_frequencies: L of PE_v, the encoding of the viewing direction.
        position_frequencies: L of PE_p, the encoding of the position.
        hidden_width: width of the hidden layers of both heads.
        thermal_feature_width: width of F_t.
        neighbours_n: n of the paper's Table 4: n² − 1 neighbours exchange heat; 1 means none.
        anchor_weight: w_a of Eq. 12, the weight of a Gaussian's own refined feature.
        surrounding_weight: w_s of Eq. 12, the weight of the mean over its neighbours.
        residual_scale: both residuals are multiplied by it, so that training starts at the plain values.
    """

    residuals: bool = True
    fourier: bool = True
    embedding_width: int = 24
    direction_frequencies: int = 4
    position_frequencies: int = 10
    hidden_width: int = 128
    thermal_feature_width: int = 32
    neighbours_n: int = 3
    anchor_weight: float = 0.9
    surrounding_weight: float = 0.1
    residual_scale: float = 0.01

    def __post_init__(self) -> None:
        if self.embedding_width < 6 or self.embedding_width % 6 != 0:
            raise ConfigError(f"embedding_width must be a positive multiple of 6, not {self.embedding_width}")
        for name in ("direction_frequencies", "position_frequencies"):
            if getattr(self, name) < 0:
                raise ConfigError(f"{name} must be 0 or more, not {getattr(self, name)}")
        for name in ("hidden_width", "thermal_feature_width", "neighbours_n"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} must be 1 or more, not {getattr(self, name)}")

        if self.neighbours_n > MAX_NEIGHBOURS_N:
            raise ConfigError(f"neighbours_n must be at most {MAX_NEIGHBOURS_N}, not {self.neighbours_n}")

    @property
    def neighbours_k(self) -> int:
        """K = n² − 1, how many neighbours each Gaussian needs; 0 if none exchange heat."""
        return self.neighbours_n**2 - 1 if self.residuals and self.fourier else 0


class RadianceField(nn.Module):
    """Colour and normalised temperature of Gaussians (Sec. Multi-modal Radiance Fields with 3D Gaussian).

    The layers start from torch's default generator: seed it for a repeatable start.

    Attributes:
        center: [3], subtracted from positions before PE_p and the embedding's start.
        scale: [], divides them; 97 % of the start points then lie inside [-1, 1].
    """

    center: Tensor
    scale: Tensor

    def __init__(self, config: FieldConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("center", torch.zeros(3))
        self.register_buffer("scale", torch.ones(()))
        if not config.residuals:
            return
        width, hidden, feature = config.embedding_width, config.hidden_width, config.thermal_feature_width
        self.color_head = ColorHead(width, config.direction_frequencies, hidden, config.residual_scale)
        self.extraction = OrthogonalExtraction(width)
        self.thermal_head = ThermalFeatureHead(width, config.position_frequencies, hidden, feature)
        self.heat = FourierHeatTransformation(
            feature, config.neighbours_k, config.anchor_weight, config.surrounding_weight
        )
        self.temperature_output = nn.Linear(feature, 1)

    def set_frame(self, start_points: Float[Tensor, "n 3"]) -> None:
        """Choose ``center`` and ``scale`` from the start points, once, before training; checkpoints carry them."""
        center, scale = position_frame(start_points)
        self.center.copy_(center)
        self.scale.copy_(scale)

    def initial_embedding(self, means: Float[Tensor, "n 3"]) -> Float[Tensor, "n c"]:
        """The start of e_m for Gaussians at these positions; no columns if the field has no residuals."""
        if not self.config.residuals:
            return means.new_zeros(len(means), 0)
        return fourier_embedding(self._normalised(means), self.config.embedding_width)

    def colors(
        self,
        gaussians: Gaussians,
        camera_position: Float[Tensor, "3"],
        sh_degree: int,
        rows: Int64[Tensor, " v"] | None = None,
    ) -> Float[Tensor, "v 3"]:
        """c + ĉ of Eq. 4 (rgb_alphblending), Sec. Rendering Overview: SH2RGB clamped at 0, plus the residual.

        Args:
            gaussians: N Gaussians.
            camera_position: centre of projection in world coordinates.
            sh_degree: highest degree of the spherical harmonics in use, 0 to 3.
            rows: Gaussians to evaluate; all if None (V = N).
        """
        directions = _directions(_take(gaussians.means, rows), camera_position)
        dc, rest = _take(gaussians.sh_dc, rows), _take(gaussians.sh_rest, rows)
        colors = (evaluate_sh(dc, rest, directions, sh_degree) + 0.5).clamp_min(0)
        if not self.config.residuals:
            return colors
        residual: Tensor = self.color_head(_take(gaussians.embedding, rows), directions)
        return colors + residual

    def temperatures(
        self,
        gaussians: Gaussians,
        neighbours: Int64[Tensor, "n k"] | None,
        camera_position: Float[Tensor, "3"],
        sh_degree: int,
        rows: Int64[Tensor, " v"] | None = None,
    ) -> Float[Tensor, "v 1"]:
        """Normalised temperatures: t + t̂ of Eq. 5 (thr_alphblending), Sec. Rendering Overview.

        t is of degree 0, so that neither t nor t̂ depends on the view. Without residuals (3DGS_RGB-T) the temperature
        is treated like a colour: spherical harmonics up to ``sh_degree``, clamped at 0.

        Args:
            gaussians: N Gaussians.
            neighbours: what ``nearest_neighbours`` returns for ``config.neighbours_k``; not read if that is 0.
            camera_position: centre of projection in world coordinates; read only without residuals.
            sh_degree: highest degree of the spherical harmonics in use; read only without residuals.
            rows: distinct Gaussians to evaluate; all if None (V = N).

        Raises:
            ValueError: heat is exchanged, but ``neighbours`` is None.
        """
        dc = _take(gaussians.temperature_dc, rows)
        if self.config.residuals:
            return C0 * dc[:, 0] + 0.5 + self._temperature_residual(gaussians, neighbours, rows)
        directions = _directions(_take(gaussians.means, rows), camera_position)
        rest = _take(gaussians.temperature_rest, rows)
        return (evaluate_sh(dc, rest, directions, sh_degree) + 0.5).clamp_min(0)

    def _temperature_residual(
        self, gaussians: Gaussians, neighbours: Int64[Tensor, "n k"] | None, rows: Int64[Tensor, " v"] | None
    ) -> Float[Tensor, "v 1"]:
        """t̂: orthogonal extraction, thermal head, heat transformation, and the output layer."""
        if self.config.neighbours_k == 0:
            neighbours = torch.empty(len(gaussians), 0, dtype=torch.int64, device=gaussians.means.device)
        if neighbours is None:
            raise ValueError(f"the heat transformation needs the {self.config.neighbours_k} nearest neighbours")
        needed = rows
        if rows is not None:
            needed, neighbours = _with_neighbours(rows, neighbours)
        sh = torch.cat([_take(gaussians.sh_dc, needed), _take(gaussians.sh_rest, needed)], dim=1)
        e_t = self.extraction(_take(gaussians.embedding, needed), sh)
        features = self.thermal_head(e_t, self._normalised(_take(gaussians.means, needed)))
        opacity = _take(gaussians.opacity_thermal, rows)
        residual = self.heat.readout(features, opacity, neighbours, self.temperature_output)
        return self.config.residual_scale * residual

    def _normalised(self, means: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        return (means - self.center) / self.scale


def _directions(means: Float[Tensor, "n 3"], camera_position: Float[Tensor, "3"]) -> Float[Tensor, "n 3"]:
    """Unit vectors from the camera to the Gaussians."""
    return nn.functional.normalize(means - camera_position.to(means), dim=1)


def _take(tensor: Float[Tensor, "n ..."], rows: Int64[Tensor, " v"] | None) -> Float[Tensor, "v ..."]:
    return tensor if rows is None else tensor.index_select(0, rows)


def _with_neighbours(
    rows: Int64[Tensor, " v"], neighbours: Int64[Tensor, "n k"]
) -> tuple[Int64[Tensor, " m"], Int64[Tensor, "v k"]]:
    """The rows followed by those of their neighbours that are not among them, and the neighbours as places therein."""
    gathered = neighbours.index_select(0, rows)
    is_extra = torch.zeros(len(neighbours), dtype=torch.bool, device=rows.device)
    is_extra[gathered.flatten()] = True
    is_extra[rows] = False
    needed = torch.cat([rows, is_extra.nonzero().squeeze(1)])
    place = torch.empty(len(neighbours), dtype=torch.int64, device=rows.device)
    place[needed] = torch.arange(len(needed), device=rows.device)
    return needed, place[gathered]
