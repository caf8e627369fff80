"""Real spherical harmonics up to degree 3, with the signs and order that 3DGS stores: band l holds
m = −l … l: √2 Im Y_l^|m| for m < 0, Y_l^0, √2 Re Y_l^m for m > 0, Y with the Condon-Shortley phase
(hence the minus signs of the odd m)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from mrgs.field.encoding import take, viewing_directions
from mrgs.system.operation import operation

MAX_DEGREE = 3
"""Highest degree, for colours and view-dependent temperatures."""

MOST_BANDS = (MAX_DEGREE + 1) ** 2 - 1
"""Basis functions of degrees 1 to 3."""

C0 = math.sqrt(1 / (4 * math.pi))
"""The constant function of degree 0: a plain value v is stored as (v − 0.5) / C0."""

C1 = math.sqrt(3 / (4 * math.pi))
C2 = math.sqrt(15 / (4 * math.pi))
C2_ZONAL = math.sqrt(5 / (16 * math.pi))
C3_ORDER1 = math.sqrt(21 / (32 * math.pi))
C3_ORDER2 = math.sqrt(105 / (4 * math.pi))
C3_ORDER3 = math.sqrt(35 / (32 * math.pi))
C3_ZONAL = math.sqrt(7 / (16 * math.pi))
"""Factors of the basis functions of degrees 1 to 3, here and in the kernels."""


def up_to_degree(rest: Float[Tensor, "n b c"], degree: int) -> Float[Tensor, "n b c"]:
    """Coefficients of degree 1 and more, those above ``degree`` replaced by zeros without gradient:
    Adam would take full steps with the small gradients of what no image shows yet."""
    used = (degree + 1) ** 2 - 1
    if used >= rest.shape[1]:
        return rest
    return nn.functional.pad(rest[:, :used], (0, 0, 0, rest.shape[1] - used))


@operation
def shade(
    means: Float[Tensor, "n 3"],
    dc: Float[Tensor, "n 1 c"],
    rest: Float[Tensor, "n b c"],
    camera_position: Float[Tensor, "3"],
    degree: int,
    rows: Int64[Tensor, " v"] | None = None,
    floor: float = 0.0,
) -> Float[Tensor, "v c"]:
    """SH2RGB of Eq. 4 (rgb_alphblending): harmonics of the viewing direction + ½, clamped at a
    floor; −∞ for no clamp. Of the Gaussians in these distinct rows, all if None (V = N); for the
    coefficients see ``evaluate_sh``."""
    directions = viewing_directions(take(means, rows), camera_position)
    values = evaluate_sh(take(dc, rows), take(rest, rows), directions, degree) + 0.5
    return values.clamp_min(floor)


def evaluate_sh(
    dc: Float[Tensor, "n 1 c"],
    rest: Float[Tensor, "n b c"],
    directions: Float[Tensor, "n 3"],
    degree: int,
) -> Float[Tensor, "n c"]:
    """Sum of coefficients times basis functions; the offset of 0.5 is left to the caller.

    Args:
        dc: coefficients of degree 0.
        rest: coefficients of the higher degrees; missing ones count as zero (B = 0, 3, 8 or 15).
        directions: unit vectors from the camera to the Gaussians; not read when only degree 0
            counts.
        degree: highest degree that counts, 0 to 3.
    """
    bands = min((degree + 1) ** 2 - 1, rest.shape[1])
    constant = C0 * dc[:, 0]
    if rest.shape[1] == 0:
        return constant
    if bands == 0:  # the rest then has a gradient of 0, as from the kernels, and not none
        return constant + rest[:, :0].sum(dim=1)
    basis = torch.stack(_basis(directions, bands), dim=1)
    return constant + torch.einsum("nb,nbc->nc", basis, rest[:, :bands])


def _basis(directions: Float[Tensor, "n 3"], bands: int) -> list[Float[Tensor, " n"]]:
    """The basis functions of degree 1 and higher, as many as ``bands`` (3, 8 or 15)."""
    x, y, z = directions.unbind(dim=1)
    functions = [-C1 * y, C1 * z, -C1 * x]
    if bands >= 8:
        functions += [
            C2 * x * y,
            -C2 * y * z,
            C2_ZONAL * (2 * z * z - x * x - y * y),
            -C2 * x * z,
            0.5 * C2 * (x * x - y * y),
        ]
    if bands >= 15:
        xx, yy, zz = x * x, y * y, z * z
        functions += [
            -C3_ORDER3 * y * (3 * xx - yy),
            C3_ORDER2 * x * y * z,
            -C3_ORDER1 * y * (4 * zz - xx - yy),
            C3_ZONAL * z * (2 * zz - 3 * xx - 3 * yy),
            -C3_ORDER1 * x * (4 * zz - xx - yy),
            0.5 * C3_ORDER2 * z * (xx - yy),
            -C3_ORDER3 * x * (xx - 3 * yy),
        ]
    return functions
