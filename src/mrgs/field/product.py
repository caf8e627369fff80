"""Products of small matrices with the same bits whatever the number of threads."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from mrgs.field import cpu


def product(a: Float[Tensor, "m k"], b: Float[Tensor, "k n"]) -> Float[Tensor, "m n"]:
    """a · b."""
    return cpu.product(a, b) if cpu.serves(a) else a @ b
