"""A perceptron with one hidden layer."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import linear, relu

from mrgs.system.operation import Kernel, operation, register_kernels


class Perceptron(nn.Module):
    """Linear, ReLU, linear."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(inputs, hidden)
        self.output = nn.Linear(hidden, outputs)

    def forward(self, inputs: Float[Tensor, "n i"]) -> Float[Tensor, "n o"]:
        """The outputs, without an activation."""
        return perceptron(
            inputs, self.hidden.weight, self.hidden.bias, self.output.weight, self.output.bias
        )


@operation
def perceptron(
    inputs: Float[Tensor, "n i"],
    hidden_weight: Float[Tensor, "h i"],
    hidden_bias: Float[Tensor, " h"],
    output_weight: Float[Tensor, "o h"],
    output_bias: Float[Tensor, " o"],
) -> Float[Tensor, "n o"]:
    """Linear, ReLU, linear; differentiable in every argument."""
    return linear(relu(linear(inputs, hidden_weight, hidden_bias)), output_weight, output_bias)


register_kernels(
    Kernel(perceptron.name, "mrgs.baselines.thermonerf.kernels.perceptron.perceptron", "cpu")
)
