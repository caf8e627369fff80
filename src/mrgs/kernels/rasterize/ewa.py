"""The mathematics of the EWA projection and its gradient, of one Gaussian: written once, and
compiled by Numba for the CPU and by Triton for a GPU.

With J the Jacobian of the perspective projection, R_w the camera's rotation, R and S the Gaussian's
rotation and scales: Σ' = N Nᵀ + d I for the 2×3 matrix N = (J R_w) R S, so that no 3×3 covariance
is ever formed. Vectors are tuples of three, matrices tuples of their rows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def functions(compiled: Callable[[Callable], Any]) -> tuple[Any, ...]:
    """The functions that kernels call, in order of definition, each compiled by the decorator
    ``compiled`` (Numba's or Triton's)."""

    @compiled
    def dot(a, b):
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    @compiled
    def cross(a, b):
        return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]

    @compiled
    def combination(a, x, b, y):
        """a x + b y of two vectors."""
        return a * x[0] + b * y[0], a * x[1] + b * y[1], a * x[2] + b * y[2]

    @compiled
    def scaled(row, scales):
        """A row vector with its entries multiplied by the scales."""
        return row[0] * scales[0], row[1] * scales[1], row[2] * scales[2]

    @compiled
    def row_times_matrix(row, rows):
        return (
            row[0] * rows[0][0] + row[1] * rows[1][0] + row[2] * rows[2][0],
            row[0] * rows[0][1] + row[1] * rows[1][1] + row[2] * rows[2][1],
            row[0] * rows[0][2] + row[1] * rows[1][2] + row[2] * rows[2][2],
        )

    @compiled
    def rotation_of(unit):
        """The rotation matrix of a normalised quaternion."""
        w, x, y, z = unit
        row0 = (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y))
        row1 = (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x))
        row2 = (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
        return row0, row1, row2

    @compiled
    def jacobian_row(focal_over_z, slope, own, forward):
        """Row 0 or 1 of M = J R_w, from R_w's rows; ``slope`` is x/z or y/z, clamped."""
        return (
            focal_over_z * (own[0] - slope * forward[0]),
            focal_over_z * (own[1] - slope * forward[1]),
            focal_over_z * (own[2] - slope * forward[2]),
        )

    @compiled
    def covariance(n0, n1, dilation):
        """Σ' = N Nᵀ + d I: its entries xx, xy, yy, and det Σ' = |n0 × n1|² + d (|n0|² + |n1|²) +
        d², a sum of what is never negative: xx yy − xy² would cancel for needles."""
        xx, yy = dot(n0, n0), dot(n1, n1)
        area = cross(n0, n1)
        determinant = dot(area, area) + (xx + yy + dilation) * dilation
        return xx + dilation, dot(n0, n1), yy + dilation, determinant

    @compiled
    def screen_gradients(n0, n1, dilation, moments):
        """∂L/∂μ' and the rows of ∂L/∂N from the moments of v = α ∂L/∂α = ∂L/∂(ln G'), in the order
        GRAD_ACROSS to GRAD_DY_DY.

        In the record's coordinates, across = dx − shear·dy and dy, Σ' is diagonal, with var(across)
        and yy, so that nothing cancels for thin slanting Gaussians: ln G' = −½ (across² /
        var(across) + dy² / yy), ∂L/∂μ' = Σ v Σ'⁻¹ d and ∂L/∂N = (Σ'⁻¹ (Σ v d dᵀ) Σ'⁻¹) N, the rows
        of N being n_across = n0 − shear·n1 = (n1 × (n0 × n1) + d n0) / yy and n1.
        """
        _, xy, yy, determinant = covariance(n0, n1, dilation)
        shear = xy / yy
        per_across, per_dy = yy / determinant, 1.0 / yy
        grad_across, grad_dy = moments[0] * per_across, moments[1] * per_dy
        across_across = moments[2] * per_across * per_across
        across_dy = moments[3] * per_across * per_dy
        dy_dy = moments[4] * per_dy * per_dy
        n_across = combination(per_dy, cross(n1, cross(n0, n1)), dilation * per_dy, n0)
        grad_n_across = combination(across_across, n_across, across_dy, n1)
        grad_n_dy = combination(across_dy, n_across, dy_dy, n1)
        grad_mean = (grad_across, grad_dy - shear * grad_across)
        return grad_mean, grad_n_across, combination(1.0, grad_n_dy, -shear, grad_n_across)

    @compiled
    def rotation_gradient(m0, m1, gp0, gp1):
        """∂L/∂R from M and ∂L/∂(M R), both by their two rows."""
        return (
            combination(m0[0], gp0, m1[0], gp1),
            combination(m0[1], gp0, m1[1], gp1),
            combination(m0[2], gp0, m1[2], gp1),
        )

    @compiled
    def quaternion_gradient(unit, inverse_length, g):
        """∂L/∂quaternion from ∂L/∂R, through the normalisation to ``unit``."""
        w, x, y, z = unit
        gw = 2 * (x * (g[2][1] - g[1][2]) + y * (g[0][2] - g[2][0]) + z * (g[1][0] - g[0][1]))
        gx = 2 * (
            y * (g[0][1] + g[1][0]) + z * (g[0][2] + g[2][0]) + w * (g[2][1] - g[1][2])
            - 2 * x * (g[1][1] + g[2][2])
        )  # fmt: skip
        gy = 2 * (
            x * (g[0][1] + g[1][0]) + z * (g[1][2] + g[2][1]) + w * (g[0][2] - g[2][0])
            - 2 * y * (g[0][0] + g[2][2])
        )  # fmt: skip
        gz = 2 * (
            x * (g[0][2] + g[2][0]) + y * (g[1][2] + g[2][1]) + w * (g[1][0] - g[0][1])
            - 2 * z * (g[0][0] + g[1][1])
        )  # fmt: skip
        along = gw * w + gx * x + gy * y + gz * z
        return (
            (gw - along * w) * inverse_length,
            (gx - along * x) * inverse_length,
            (gy - along * y) * inverse_length,
            (gz - along * z) * inverse_length,
        )

    return (
        dot, scaled, row_times_matrix, rotation_of, jacobian_row, covariance, screen_gradients,
        rotation_gradient, quaternion_gradient,
    )  # fmt: skip
