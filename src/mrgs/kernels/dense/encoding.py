"""The positional encoding of a block of points, and its gradient: Eq. 9 (positional_embedding)."""

from __future__ import annotations

import math

import numpy as np

from mrgs.kernels.jit import reordering_inner_function, reordering_kernel

# sin(πt) / t on [-1/2, 1/2] as a polynomial in t², fitted at the Chebyshev nodes: error 3e-11
# before rounding.
_SINE = tuple(
    np.float32(c)
    for c in (3.141592654, -5.167712765, 2.550163319, -0.5992521978, 0.08205040173, -0.007028386281)
)
_PI = np.float32(math.pi)
_HALF, _ONE, _TWO = np.float32(0.5), np.float32(1), np.float32(2)


@reordering_kernel
def encode(x, frequencies, out):
    """PE(x) of points [R, 3] -> [R, 6 L]: for each n the sines of 2ⁿπx, then the cosines.

    The sines come first into a list of their own, so that the compiler can compute many at once.
    """
    width = 3 * frequencies
    half_turns = np.empty(x.shape[0] * width, np.float32)
    for row in range(x.shape[0]):
        factor = _ONE
        for n in range(frequencies):
            for axis in range(3):
                half_turns[row * width + 3 * n + axis] = factor * x[row, axis]
            factor *= _TWO
    sines, cosines = np.empty_like(half_turns), np.empty_like(half_turns)
    for place in range(half_turns.size):
        sines[place], cosines[place] = _sine_and_cosine(half_turns[place])
    for row in range(x.shape[0]):
        for n in range(frequencies):
            for axis in range(3):
                out[row, 6 * n + axis] = sines[row * width + 3 * n + axis]
                out[row, 6 * n + 3 + axis] = cosines[row * width + 3 * n + axis]


@reordering_kernel
def encode_backward(encoded, grad, row, start, frequencies, grad_x):
    """Add the gradient at one point x to ``grad_x`` [3]: sin' = 2ⁿπ cos, cos' = −2ⁿπ sin.

    PE(x) and its gradient stand in one row of ``encoded`` and ``grad``, from the column ``start``.
    """
    factor = _PI
    for n in range(frequencies):
        for axis in range(3):
            sine, cosine = start + 6 * n + axis, start + 6 * n + 3 + axis
            grad_x[axis] += factor * (
                grad[row, sine] * encoded[row, cosine] - grad[row, cosine] * encoded[row, sine]
            )
        factor *= _TWO


@reordering_inner_function
def _sine_and_cosine(half_turns):
    """sin(πy) and cos(πy) within 3e-7, however large y is: y − round(y) is exact where the product
    πy is not."""
    whole = np.rint(half_turns)
    t = half_turns - whole
    sign = _ONE - _TWO * abs(whole - _TWO * np.rint(_HALF * whole))
    return sign * _sine(t), sign * _sine(_HALF - abs(t))


@reordering_inner_function
def _sine(t):
    s = t * t
    return t * (
        _SINE[0] + s * (_SINE[1] + s * (_SINE[2] + s * (_SINE[3] + s * (_SINE[4] + s * _SINE[5]))))
    )
