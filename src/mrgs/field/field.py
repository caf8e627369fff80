"""The radiance field: colour and temperature of each Gaussian, as the rasterizer blends them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from mrgs.errors import ConfigError
from mrgs.field.appearance import (
    ColorHead,
    OrthogonalExtraction,
    ThermalFeatureHead,
    color_residuals,
)
from mrgs.field.encoding import fourier_embedding, position_frame, take
from mrgs.field.heat import FourierHeatTransformation, nearest_neighbours
from mrgs.field.spherical_harmonics import C0, MAX_DEGREE, shade, up_to_degree
from mrgs.scene import RGB, THERMAL, Gaussians, Modality
from mrgs.system.operation import operation
from mrgs.system.strict_yaml import MOST_WEIGHT, MOST_WIDTH, require_within
from mrgs.system.wording import shown

MAX_NEIGHBOURS_N = 16
"""255 neighbours of each Gaussian; the paper stops at 48."""

MAX_FREQUENCIES = 24
"""Largest number of frequencies of an encoding: float32 has no more binary digits."""


@dataclass(frozen=True)
class FieldConfig:
    """How the blended values follow from the Gaussians' parameters.

    Attributes:
        residuals: add the learned residuals ĉ and t̂; off for 3DGS_RGB-T, which blends spherical
            harmonics alone.
        clamp_temperature: without residuals, clamp t at the cold end of the scale, as colours at
            black. A cold bridge is colder than any pixel that blurs it: without the clamp its
            Gaussians keep a gradient, as those of a hot spot above the hot end do.
        fourier: let neighbours exchange heat (the Fourier heat transformation).
        embedding_width: C of the multi-modal embedding e_m; a multiple of 6.
        direction_frequencies: L of PE_v, the encoding of the viewing direction.
        position_frequencies: L of PE_p, the encoding of the position.
        hidden_width: width of the hidden layers of both heads.
        thermal_feature_width: width of F_t.
        neighbours_n: n of the paper's Table 4: n² − 1 neighbours exchange heat; 1 means none.
        anchor_weight: w_a of Eq. 12, the weight of a Gaussian's own refined feature.
        surrounding_weight: w_s of Eq. 12, the weight of the mean over its neighbours.
        color_scale: ĉ is multiplied by it, so that training starts at the plain colours.
        temperature_scale: t̂ is multiplied by it, so that training starts at the plain temperatures.
    """

    residuals: bool = True
    clamp_temperature: bool = True
    fourier: bool = True
    embedding_width: int = 24
    direction_frequencies: int = 4
    position_frequencies: int = 10
    hidden_width: int = 128
    thermal_feature_width: int = 32
    neighbours_n: int = 3
    anchor_weight: float = 0.9
    surrounding_weight: float = 0.1
    color_scale: float = 0.01
    temperature_scale: float = 0.01

    def __post_init__(self) -> None:
        if self.embedding_width < 6 or self.embedding_width % 6 != 0:
            width = shown(self.embedding_width)
            raise ConfigError(f"embedding_width must be a positive multiple of 6, not {width}")
        require_within(self, ("direction_frequencies", "position_frequencies"), 0, MAX_FREQUENCIES)
        widths = ("embedding_width", "hidden_width", "thermal_feature_width")
        require_within(self, widths, 1, MOST_WIDTH)
        require_within(self, ["neighbours_n"], 1, MAX_NEIGHBOURS_N)
        factors = ("anchor_weight", "surrounding_weight", "color_scale", "temperature_scale")
        require_within(self, factors, -MOST_WEIGHT, MOST_WEIGHT)

    @property
    def neighbours_k(self) -> int:
        """K = n² − 1, how many neighbours each Gaussian needs; 0 if none exchange heat."""
        return self.neighbours_n**2 - 1 if self.residuals and self.fourier else 0


class RadianceField(nn.Module):
    """Colour and normalised temperature of Gaussians (Sec. Multi-modal Radiance Fields with 3D
    Gaussian).

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
        width, hidden = config.embedding_width, config.hidden_width
        feature = config.thermal_feature_width
        self.color_head = ColorHead(width, config.direction_frequencies, hidden, config.color_scale)
        self.extraction = OrthogonalExtraction(width)
        self.thermal_head = ThermalFeatureHead(width, config.position_frequencies, hidden, feature)
        self.heat = FourierHeatTransformation(
            feature, config.neighbours_k, config.anchor_weight, config.surrounding_weight
        )
        self.temperature_output = nn.Linear(feature, 1)

    def set_frame(self, start_points: Float[Tensor, "n 3"]) -> None:
        """Choose ``center`` and ``scale`` from the start points, once; checkpoints carry them."""
        center, scale = position_frame(start_points)
        self.center.copy_(center)
        self.scale.copy_(scale)

    def initial_embedding(self, means: Float[Tensor, "n 3"]) -> Float[Tensor, "n c"]:
        """The start of e_m for Gaussians at these positions; no columns without residuals."""
        if not self.config.residuals:
            return means.new_zeros(len(means), 0)
        return fourier_embedding(self.normalised(means), self.config.embedding_width)

    def colors(
        self,
        gaussians: Gaussians,
        camera_position: Float[Tensor, "3"],
        sh_degree: int,
        rows: Int64[Tensor, " v"] | None = None,
    ) -> Float[Tensor, "v 3"]:
        """c + ĉ of Eq. 4 (rgb_alphblending), Sec. Rendering Overview: SH2RGB clamped at 0, plus the
        residual; see ``intensities``."""
        c = self.intensities(RGB, gaussians, camera_position, sh_degree, rows)
        if not self.config.residuals:
            return c
        means, position = gaussians.means, camera_position.to(gaussians.means)
        c_hat = color_residuals(self.color_head, gaussians.embedding, means, position, rows)
        return c + c_hat

    def temperatures(
        self,
        gaussians: Gaussians,
        neighbours: Int64[Tensor, "n k"] | None,
        camera_position: Float[Tensor, "3"],
        sh_degree: int,
        rows: Int64[Tensor, " v"] | None = None,
        *,
        residuals: Float[Tensor, "n 1"] | None = None,
        color_degree: int = MAX_DEGREE,
    ) -> Float[Tensor, "v 1"]:
        """Normalised temperatures: t + t̂ of Eq. 5 (thr_alphblending), Sec. Rendering Overview.

        As published t is of degree 0, so that neither t nor t̂ depends on the view; t of a higher
        degree does. Without residuals (3DGS_RGB-T) the temperature is treated like a colour:
        harmonics up to ``sh_degree``, clamped at 0 unless ``clamp_temperature`` is off. Errors as
        for ``intensities`` and ``temperature_residuals``.

        Args:
            neighbours: see ``temperature_residuals``; not read if t̂ is known.
            camera_position: centre of projection in world coordinates; not read where t is of
                degree 0.
            sh_degree: highest degree of the temperature's spherical harmonics in use.
            rows: distinct Gaussians to evaluate; all if None (V = N).
            residuals: t̂ of all Gaussians, where it is known.
            color_degree: see ``temperature_residuals``.
        """
        if not self.config.residuals:
            floor = 0.0 if self.config.clamp_temperature else -math.inf
            return self.intensities(THERMAL, gaussians, camera_position, sh_degree, rows, floor)
        if residuals is None:
            t_hat = self.temperature_residuals(gaussians, neighbours, rows, color_degree)
        else:
            t_hat = take(residuals, rows)
        if gaussians.depends_on_view(THERMAL):
            t = self.intensities(THERMAL, gaussians, camera_position, sh_degree, rows, -math.inf)
        else:
            t = C0 * take(gaussians.sh_dc[THERMAL], rows)[:, 0] + 0.5
        return t + t_hat

    def intensities(
        self,
        modality: Modality,
        gaussians: Gaussians,
        camera_position: Float[Tensor, "3"],
        sh_degree: int,
        rows: Int64[Tensor, " v"] | None = None,
        floor: float = 0.0,
    ) -> Float[Tensor, "v c"]:
        """A modality's spherical harmonics, SH2RGB of Eq. 4: c of RGB, and all there is of a
        modality that is not in the paper. IndexError on the CPU for rows that do not exist.

        Args:
            modality: one that the Gaussians have, of C channels.
            camera_position: centre of projection in world coordinates.
            sh_degree: highest degree of the spherical harmonics in use, 0 to 3.
            rows: distinct Gaussians to evaluate; all if None (V = N).
            floor: smallest value; −∞ for no clamp.
        """
        dc, rest = gaussians.sh_dc[modality], gaussians.sh_rest[modality]
        position = camera_position.to(gaussians.means)
        return shade(gaussians.means, dc, rest, position, sh_degree, rows, floor)

    @operation
    def temperature_residuals(
        self,
        gaussians: Gaussians,
        neighbours: Int64[Tensor, "n k"] | None,
        rows: Int64[Tensor, " v"] | None = None,
        color_degree: int = MAX_DEGREE,
    ) -> Float[Tensor, "v 1"]:
        """t̂ of Eq. 5, of a field with residuals: orthogonal extraction (Eq. 7–8), thermal head on
        PE_p (Eq. 9), heat transformation (Eq. 10–12), output layer.

        Args:
            neighbours: what ``neighbours_of`` returns; not read if the field exchanges no heat.
            rows: distinct Gaussians to evaluate; all if None (V = N).
            color_degree: highest degree of the colour's spherical harmonics in use; the extraction
                takes those of higher degrees as 0, and gives them no gradient.

        Raises:
            ValueError: heat is exchanged, but ``neighbours`` is None or of another shape.
            IndexError: neighbours on the CPU that do not exist.
        """
        neighbours = self.checked_neighbours(neighbours, len(gaussians))
        rest = up_to_degree(gaussians.sh_rest[RGB], color_degree)
        sh = torch.cat([gaussians.sh_dc[RGB], rest], dim=1)
        e_t = self.extraction(gaussians.embedding, sh)
        features = self.thermal_head(e_t, self.normalised(gaussians.means))
        refined = self.heat(features, gaussians.opacity(THERMAL), neighbours)
        t_hat = self.config.temperature_scale * self.temperature_output(refined)
        return take(t_hat, rows)

    def neighbours_of(self, means: Float[Tensor, "n 3"]) -> Int64[Tensor, "n k"] | None:
        """The neighbours of Gaussians at these positions, as ``temperatures`` takes them; None if
        the field exchanges no heat."""
        k = self.config.neighbours_k
        return nearest_neighbours(means, k) if k > 0 else None

    def checked_neighbours(
        self, neighbours: Int64[Tensor, "n k"] | None, count: int
    ) -> Int64[Tensor, "n k"]:
        """The neighbours of all Gaussians, whose count is given; no columns for a field that
        exchanges no heat. ValueError if neighbours are needed, but are None or of another shape."""
        k = self.config.neighbours_k
        if k == 0:
            return torch.empty(count, 0, dtype=torch.int64, device=self.center.device)
        if neighbours is None:
            raise ValueError(f"the heat transformation needs the {k} nearest neighbours")
        if neighbours.shape != (count, k):
            shape = tuple(neighbours.shape)
            raise ValueError(f"neighbours of {count} Gaussians are needed, not of shape {shape}")
        return neighbours

    def normalised(self, means: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Positions as PE_p takes them, most of them inside [-1, 1]."""
        return (means - self.center) / self.scale
