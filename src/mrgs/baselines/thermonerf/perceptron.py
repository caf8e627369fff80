"""A perceptron with one hidden layer."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from mrgs.baselines.thermonerf import cpu


class Perceptron(nn.Module):
    """Linear, ReLU, linear; a fused kernel for float32."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(inputs, hidden)
        self.output = nn.Linear(hidden, outputs)

    def forward(self, inputs: Float[Tensor, "n i"]) -> Float[Tensor, "n o"]:
        """The outputs, without an activation."""
        return cpu.perceptron(
            inputs, self.hidden.weight, self.hidden.bias, self.output.weight, self.output.bias
        )
