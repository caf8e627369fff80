"""The shared Gaussians: one geometry, one opacity per modality."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass
class Gaussians:
    """Parameters of N Gaussians (row i of every tensor belongs to Gaussian i).

    Attributes:
        means: centres μ in world coordinates, [N, 3].
        quats: rotations as quaternions wxyz, not necessarily normalised, [N, 4].
        log_scales: natural logarithm of the standard deviations along the rotated axes, [N, 3].
        opacity_rgb_logit: logit of o_c, [N, 1].
        opacity_thermal_logit: logit of o_t, [N, 1]; [N, 0] if both modalities share o_c
            (3DGS_RGB-T).
        sh_dc: spherical-harmonics coefficient of degree 0 per colour channel, [N, 1, 3].
        sh_rest: coefficients of degrees 1 to 3, [N, 15, 3].
        temperature_dc: the same for the normalised temperature t_i, degree 0, [N, 1, 1].
        temperature_rest: the higher degrees of the temperature; [N, 15, 1] for 3DGS_RGB-T, [N, 0,
            1] for MrGS as published, whose t_i does not depend on the view.
        embedding: the multi-modal embedding e_m, [N, C]; C = 0 for 3DGS_RGB-T.
    """

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    log_scales: Float[Tensor, "n 3"]
    opacity_rgb_logit: Float[Tensor, "n 1"]
    opacity_thermal_logit: Float[Tensor, "n s"]
    sh_dc: Float[Tensor, "n 1 3"]
    sh_rest: Float[Tensor, "n 15 3"]
    temperature_dc: Float[Tensor, "n 1 1"]
    temperature_rest: Float[Tensor, "n b 1"]
    embedding: Float[Tensor, "n c"]

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def scales(self) -> Float[Tensor, "n 3"]:
        """Standard deviations along the rotated axes, in scene units."""
        return self.log_scales.exp()

    @property
    def opacity_rgb(self) -> Float[Tensor, " n"]:
        """o_c in (0, 1)."""
        return self.opacity_rgb_logit[:, 0].sigmoid()

    @property
    def temperature_depends_on_view(self) -> bool:
        """Whether there are harmonics above degree 0."""
        return self.temperature_rest.shape[1] > 0

    @property
    def opacity_thermal(self) -> Float[Tensor, " n"]:
        """o_t in (0, 1)."""
        shares_opacity = self.opacity_thermal_logit.shape[1] == 0
        return self.opacity_rgb if shares_opacity else self.opacity_thermal_logit[:, 0].sigmoid()

    @property
    def sh(self) -> Float[Tensor, "n 16 3"]:
        """All colour coefficients."""
        return torch.cat([self.sh_dc, self.sh_rest], dim=1)

    def to(self, device: torch.device) -> Gaussians:
        """Copies on a device, without gradients."""
        return Gaussians(
            **{name: tensor.detach().to(device) for name, tensor in self.tensors().items()}
        )

    def tensors(self) -> dict[str, Tensor]:
        """The parameters by name, in the order of declaration (not copied)."""
        return {field.name: getattr(self, field.name) for field in fields(self)}
