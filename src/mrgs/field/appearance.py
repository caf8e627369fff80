"""The multi-modal embedding e_m, and what is read from it: colour residual, thermal feature."""

from __future__ import annotations

from typing import TypeAlias

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from mrgs.field.encoding import positional_encoding, take, viewing_directions
from mrgs.system.operation import operation

SH_COEFFICIENTS = 48
"""16 basis functions times 3 colour channels."""


Embedding: TypeAlias = Float[Tensor, "n c"]
Vectors: TypeAlias = Float[Tensor, "n 3"]


def reject(embedding: Embedding, direction: Embedding) -> Embedding:
    """e_orth = e_m − e_proj, the part of each embedding that is orthogonal to its direction SH'.
    Eq. 7 (embedding_proj), Sec. Orthogonal Embedding Extraction: e_proj = (e_m · SH') / ‖SH'‖² SH',
    with 1e-8 added to ‖SH'‖², so that a vanishing direction removes nothing."""
    dot = (embedding * direction).sum(dim=1, keepdim=True)
    squared_norm = direction.square().sum(dim=1, keepdim=True)
    return embedding - dot / (squared_norm + 1e-8) * direction


class OrthogonalExtraction(nn.Module):
    """e_t, the view-invariant part of e_m. Eq. 7 (embedding_proj) and 8 (embedding_t), Sec.
    Orthogonal Embedding Extraction: SH' = φ_SH(SH), e_t = φ_e(e_m − e_proj) with single linear
    layers φ. Nothing is detached: the thermal loss also reaches SH."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.phi_sh = nn.Linear(SH_COEFFICIENTS, width)
        self.phi_e = nn.Linear(width, width)

    def forward(self, embedding: Embedding, sh: Float[Tensor, "n 16 3"]) -> Embedding:
        """e_t from e_m and all colour coefficients, 0 for those of degrees not yet in use."""
        e_t: Tensor = self.phi_e(reject(embedding, self.phi_sh(sh.flatten(1))))
        return e_t


class ColorHead(nn.Module):
    """The colour residual ĉ, Sec. Rendering Overview: an MLP on e_m ⊕ PE_v of the viewing
    direction, L frequencies, times a scale: training starts at the plain spherical harmonics."""

    def __init__(
        self, embedding_width: int, frequencies: int, hidden_width: int, scale: float
    ) -> None:
        super().__init__()
        self.frequencies = frequencies
        self.scale = scale
        self.mlp = nn.Sequential(
            nn.Linear(embedding_width + 6 * frequencies, hidden_width),
            nn.ReLU(inplace=True),
            nn.Linear(hidden_width, hidden_width),
            nn.ReLU(inplace=True),
            nn.Linear(hidden_width, 3),
        )

    def forward(self, embedding: Embedding, directions: Vectors) -> Vectors:
        """ĉ of each Gaussian; directions are unit vectors from the camera to its centre."""
        inputs = torch.cat([embedding, positional_encoding(directions, self.frequencies)], dim=1)
        residual: Tensor = self.scale * self.mlp(inputs)
        return residual


@operation
def color_residuals(
    head: ColorHead,
    embedding: Embedding,
    means: Vectors,
    camera_position: Float[Tensor, "3"],
    rows: Int64[Tensor, " v"] | None = None,
) -> Float[Tensor, "v 3"]:
    """ĉ of Eq. 4 (rgb_alphblending): the colour head on e_m and the viewing direction, of the
    Gaussians in these distinct rows, all if None (V = N)."""
    directions = viewing_directions(take(means, rows), camera_position)
    residuals: Tensor = head(take(embedding, rows), directions)
    return residuals


class ThermalFeatureHead(nn.Module):
    """The thermal feature F_t, Sec. Rendering Overview: an MLP on e_t ⊕ PE_p of the position. The
    positions are detached inside PE_p: the gradient of its top frequency, 2⁹π by default, would
    shake the geometry instead of moving it."""

    def __init__(
        self, embedding_width: int, frequencies: int, hidden_width: int, feature_width: int
    ) -> None:
        super().__init__()
        self.frequencies = frequencies
        self.mlp = nn.Sequential(
            nn.Linear(embedding_width + 6 * frequencies, hidden_width),
            nn.ReLU(inplace=True),
            nn.Linear(hidden_width, feature_width),
        )

    def forward(self, e_t: Embedding, positions: Vectors) -> Float[Tensor, "n f"]:
        """F_t of each Gaussian; positions are normalised to about [-1, 1]."""
        inputs = torch.cat([e_t, positional_encoding(positions.detach(), self.frequencies)], dim=1)
        features: Tensor = self.mlp(inputs)
        return features
