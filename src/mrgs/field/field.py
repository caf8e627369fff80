"""The radiance field: colour and temperature of each Gaussian, as the rasterizer blends them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from mrgs.errors import ConfigError
from mrgs.field import cpu
from mrgs.field.appearance import ColorHead, OrthogonalExtraction, ThermalFeatureHead, linear_layers
from mrgs.field.encoding import fourier_embedding, position_frame
from mrgs.field.heat import FourierHeatTransformation, with_neighbours
from mrgs.field.product import product
from mrgs.field.spherical_harmonics import C0, evaluate_sh
from mrgs.scene.gaussians import Gaussians

MAX_NEIGHBOURS_N = 16
"""255 neighbours of each Gaussian; the paper stops at 48."""


@dataclass(frozen=True)
class FieldConfig:
    """What stands between the Gaussians' parameters and the values that are blended.

    Attributes:
        residuals: add the learned residuals ĉ and t̂; off for 3DGS_RGB-T, which blends spherical
            harmonics alone.
        fourier: let neighbours exchange heat (the Fourier heat transformation).
        embedding_width: C of the multi-modal embedding e_m; a multiple of 6.
        direction_frequencies: L of PE_v, the encoding of the viewing direction.
        position_frequencies: L of PE_p, the encoding of the position.
        hidden_width: width of the hidden layers of both heads.
        thermal_feature_width: width of F_t.
        neighbours_n: n of the paper's Table 4: n² − 1 neighbours exchange heat; 1 means none.
        anchor_weight: w_a of Eq. 12, the weight of a Gaussian's own refined feature.
        surrounding_weight: w_s of Eq. 12, the weight of the mean over its neighbours.
        residual_scale: both residuals are multiplied by it, so that training starts at the plain
            values.
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
            raise ConfigError(
                f"embedding_width must be a positive multiple of 6, not {self.embedding_width}"
            )
        for name in ("direction_frequencies", "position_frequencies"):
            if getattr(self, name) < 0:
                raise ConfigError(f"{name} must be 0 or more, not {getattr(self, name)}")
        for name in ("hidden_width", "thermal_feature_width", "neighbours_n"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} must be 1 or more, not {getattr(self, name)}")

        if self.neighbours_n > MAX_NEIGHBOURS_N:
            raise ConfigError(
                f"neighbours_n must be at most {MAX_NEIGHBOURS_N}, not {self.neighbours_n}"
            )

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
        width, hidden, feature = (
            config.embedding_width,
            config.hidden_width,
            config.thermal_feature_width,
        )
        self.color_head = ColorHead(
            width, config.direction_frequencies, hidden, config.residual_scale
        )
        self.extraction = OrthogonalExtraction(width)
        self.thermal_head = ThermalFeatureHead(width, config.position_frequencies, hidden, feature)
        self.heat = FourierHeatTransformation(
            feature, config.neighbours_k, config.anchor_weight, config.surrounding_weight
        )
        self.temperature_output = nn.Linear(feature, 1)

    def set_frame(self, start_points: Float[Tensor, "n 3"]) -> None:
        """Choose ``center`` and ``scale`` from the start points, once, before training; checkpoints
        carry them."""
        center, scale = position_frame(start_points)
        self.center.copy_(center)
        self.scale.copy_(scale)

    def initial_embedding(self, means: Float[Tensor, "n 3"]) -> Float[Tensor, "n c"]:
        """The start of e_m for Gaussians at these positions; no columns if the field has no
        residuals."""
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
        """c + ĉ of Eq. 4 (rgb_alphblending), Sec. Rendering Overview: SH2RGB clamped at 0, plus the
        residual.

        Args:
            gaussians: N Gaussians.
            camera_position: centre of projection in world coordinates.
            sh_degree: highest degree of the spherical harmonics in use, 0 to 3.
            rows: distinct Gaussians to evaluate; all if None (V = N).

        Raises:
            IndexError: rows on the CPU that do not exist.
        """
        _check_places("rows", rows, len(gaussians))
        camera_position = camera_position.to(gaussians.means)
        colors = _shade(
            gaussians.means, gaussians.sh_dc, gaussians.sh_rest, camera_position, sh_degree, rows
        )
        return (
            colors + self._color_residual(gaussians, camera_position, rows)
            if self.config.residuals
            else colors
        )

    def temperatures(
        self,
        gaussians: Gaussians,
        neighbours: Int64[Tensor, "n k"] | None,
        camera_position: Float[Tensor, "3"],
        sh_degree: int,
        rows: Int64[Tensor, " v"] | None = None,
        residuals: Float[Tensor, "n 1"] | None = None,
    ) -> Float[Tensor, "v 1"]:
        """Normalised temperatures: t + t̂ of Eq. 5 (thr_alphblending), Sec. Rendering Overview.

        As published t is of degree 0, so that neither t nor t̂ depends on the view; t of a higher
        degree does. Without residuals (3DGS_RGB-T) the temperature is treated like a colour:
        harmonics up to ``sh_degree``, clamped at 0.

        Args:
            gaussians: N Gaussians.
            neighbours: what ``nearest_neighbours`` returns for ``config.neighbours_k``; not read if
                that is 0, or if t̂ is known.
            camera_position: centre of projection in world coordinates; not read where t is of
                degree 0.
            sh_degree: highest degree of the spherical harmonics in use.
            rows: distinct Gaussians to evaluate; all if None (V = N).
            residuals: t̂ of all Gaussians, where it is known; not read by a field without
                residuals.

        Raises:
            ValueError: t̂ is not known and heat is exchanged, but ``neighbours`` is None or of
                another shape.
            IndexError: rows or neighbours on the CPU that do not exist.
        """
        _check_places("rows", rows, len(gaussians))
        camera_position = camera_position.to(gaussians.means)
        dc, rest = gaussians.temperature_dc, gaussians.temperature_rest
        if not self.config.residuals:
            return _shade(gaussians.means, dc, rest, camera_position, sh_degree, rows)
        if gaussians.temperature_depends_on_view:
            t = _shade(gaussians.means, dc, rest, camera_position, sh_degree, rows, floor=-math.inf)
        else:
            t = C0 * _take(dc, rows)[:, 0] + 0.5
        if residuals is None:
            return t + self.temperature_residuals(gaussians, neighbours, rows)
        return t + _take(residuals, rows)

    def _color_residual(
        self,
        gaussians: Gaussians,
        camera_position: Float[Tensor, "3"],
        rows: Int64[Tensor, " v"] | None,
    ) -> Float[Tensor, "v 3"]:
        """ĉ: the colour head on e_m and the viewing direction."""
        head, means, embedding = self.color_head, gaussians.means, gaussians.embedding
        if cpu.serves(means):
            *hidden, (weight, bias) = linear_layers(head.mlp)
            layers = [*hidden, (head.scale * weight, head.scale * bias)]
            listed = _listed(rows, means)
            return cpu.color_residual(
                layers, embedding, means, camera_position, head.frequencies, listed
            )
        residual: Tensor = head(
            _take(embedding, rows), _directions(_take(means, rows), camera_position)
        )
        return residual

    def temperature_residuals(
        self,
        gaussians: Gaussians,
        neighbours: Int64[Tensor, "n k"] | None,
        rows: Int64[Tensor, " v"] | None = None,
    ) -> Float[Tensor, "v 1"]:
        """t̂: orthogonal extraction, thermal head, heat transformation, and the output layer.

        Arguments and errors are those of ``temperatures``; the field must have residuals.
        """
        if self.config.neighbours_k == 0:
            neighbours = torch.empty(
                len(gaussians), 0, dtype=torch.int64, device=gaussians.means.device
            )
        if neighbours is None:
            raise ValueError(
                f"the heat transformation needs the {self.config.neighbours_k} nearest neighbours"
            )
        if neighbours.shape != (len(gaussians), self.config.neighbours_k):
            raise ValueError(
                f"neighbours of {len(gaussians)} Gaussians are needed, not of shape "
                f"{tuple(neighbours.shape)}"
            )
        _check_places("neighbours", neighbours, len(gaussians))
        projected = self._projected_features(gaussians, _needed(rows, neighbours))
        opacity = _take(gaussians.opacity_thermal, rows)
        anchors = _listed(rows, gaussians.means)
        return self.config.residual_scale * self.heat.readout(
            projected, opacity, neighbours, anchors, self.temperature_output
        )

    def _projected_features(
        self, gaussians: Gaussians, rows: Int64[Tensor, " m"] | None
    ) -> Float[Tensor, "n r"]:
        """What neighbours read of each F_t (``FourierHeatTransformation.readout``); 0 where not
        asked for."""
        readout_rows = self.heat.readout_rows(self.temperature_output)
        means, embedding = gaussians.means, gaussians.embedding
        if cpu.serves(means):
            layers = (
                self.extraction.phi_sh.weight,
                self.extraction.phi_sh.bias,
                *self._merged_layers(readout_rows),
            )
            positions, frequencies = self._normalised(means.detach()), self.thermal_head.frequencies
            return cpu.project_features(
                embedding,
                gaussians.sh_dc,
                gaussians.sh_rest,
                layers,
                positions,
                frequencies,
                _listed(rows, means),
            )
        sh = torch.cat([_take(gaussians.sh_dc, rows), _take(gaussians.sh_rest, rows)], dim=1)
        e_t = self.extraction(_take(embedding, rows), sh)
        projected = self.thermal_head(e_t, self._normalised(_take(means, rows))) @ readout_rows.T
        if rows is None:
            return projected
        return projected.new_zeros(len(means), projected.shape[1]).index_copy(0, rows, projected)

    def _merged_layers(
        self, readout_rows: Float[Tensor, "r f"]
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Weight and bias of two layers around the thermal head's ReLU, each the product of two
        linear layers.

        φ_e of Eq. 8 goes into the first, W (φ_e(x) ⊕ PE_p) = W_e φ_e x + W_e b_e + W_p PE_p; the
        read-out into the second. Both biases pass through the product as one more column.
        """
        phi_e, ((weight, bias), last) = self.extraction.phi_e, linear_layers(self.thermal_head.mlp)
        of_e_t, of_position = weight.tensor_split([len(phi_e.weight)], dim=1)
        first = product(of_e_t, torch.cat([phi_e.weight, phi_e.bias[:, None]], dim=1))
        second = product(readout_rows, torch.cat([last[0], last[1][:, None]], dim=1))
        return (
            torch.cat([first[:, :-1], of_position], dim=1),
            first[:, -1] + bias,
            second[:, :-1],
            second[:, -1],
        )

    def _normalised(self, means: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        return (means - self.center) / self.scale


def _shade(
    means: Float[Tensor, "n 3"],
    dc: Float[Tensor, "n 1 c"],
    rest: Float[Tensor, "n b c"],
    camera_position: Float[Tensor, "3"],
    degree: int,
    rows: Int64[Tensor, " v"] | None,
    floor: float = 0.0,
) -> Float[Tensor, "v c"]:
    """SH2RGB: spherical harmonics plus 0.5, clamped at the floor."""
    if cpu.serves(means):
        return cpu.shade(means, dc, rest, camera_position, degree, _listed(rows, means), floor)
    directions = _directions(_take(means, rows), camera_position)
    return (evaluate_sh(_take(dc, rows), _take(rest, rows), directions, degree) + 0.5).clamp_min(
        floor
    )


def _directions(
    means: Float[Tensor, "n 3"], camera_position: Float[Tensor, "3"]
) -> Float[Tensor, "n 3"]:
    """Unit vectors from the camera to the Gaussians."""
    return nn.functional.normalize(means - camera_position, dim=1)


def _take(
    tensor: Float[Tensor, "n ..."], rows: Int64[Tensor, " v"] | None
) -> Float[Tensor, "v ..."]:
    return tensor if rows is None else tensor.index_select(0, rows)


def _listed(rows: Int64[Tensor, " v"] | None, means: Float[Tensor, "n 3"]) -> Int64[Tensor, " v"]:
    return torch.arange(len(means), device=means.device) if rows is None else rows


def _needed(
    rows: Int64[Tensor, " v"] | None, neighbours: Int64[Tensor, "n k"]
) -> Int64[Tensor, " m"] | None:
    """These Gaussians and their neighbours; all (None) on a GPU: to learn how many they are the
    host would wait."""
    return None if rows is None or rows.device.type != "cpu" else with_neighbours(rows, neighbours)


def _check_places(name: str, places: Int64[Tensor, "..."] | None, count: int) -> None:
    """The kernels do not look again; a GPU is not asked, because the host would wait for its
    answer."""
    if places is None or places.device.type != "cpu" or places.numel() == 0:
        return
    if not (places.min() >= 0 and places.max() < count):
        raise IndexError(
            f"{name} must lie in 0 to {count - 1}, but reach from {places.min()} to {places.max()}"
        )
