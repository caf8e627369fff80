"""t̂ without F': behind F_t everything is linear but for the factor o_t, so the output row w is
carried through the layers instead of the features.

With v = f_qᵀ w and a_k = f_grad,kᵀ v,

    w · q_i = w · b_q − o_t,i · (Σ_k a_k · (F_{u_k} − F_i) + v · b_grad)

and a Gaussian passes K + 1 numbers to its neighbours (a_k · F and w · F) where Eq. 11 passes K
vectors. The products of weights are given as a function, because the CPU has one of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mrgs.field.heat import FourierHeatTransformation

Product: TypeAlias = Callable[[Tensor, Tensor], Tensor]
"""a · b of two matrices."""


def readout_rows(
    heat: FourierHeatTransformation, output: nn.Linear, product: Product
) -> Float[Tensor, "r c"]:
    """a_1 … a_K and w, as rows: what an anchor reads of its neighbours' features and of its own.

    Args:
        heat: of C channels.
        output: the layer behind F', of one channel.
        product: of two matrices.
    """
    w = output.weight
    if heat.k == 0:
        return w
    taps = product(_through_f_q(heat, w, product), heat.f_grad.weight.flatten(1)).view(-1, heat.k)
    return torch.cat([taps.T, w])


def readout_constants(
    heat: FourierHeatTransformation, output: nn.Linear, product: Product
) -> Float[Tensor, "3"]:
    """w · b_q, v · b_grad and the output's bias; the arguments are those of ``readout_rows``."""
    w = output.weight
    v = _through_f_q(heat, w, product)
    return torch.stack(
        [(w * _bias(heat.f_q)).sum(), (v * _bias(heat.f_grad)).sum(), output.bias[0]]
    )


def _through_f_q(
    heat: FourierHeatTransformation, w: Float[Tensor, "1 c"], product: Product
) -> Float[Tensor, "1 c"]:
    """v = f_qᵀ w, as a row."""
    return product(w, heat.f_q.weight[:, :, 0])


def _bias(layer: nn.Conv1d) -> Tensor:
    assert layer.bias is not None
    return layer.bias
