"""What the kernels refuse: inside they trust sizes, types and indices."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from mrgs.field import FieldConfig, RadianceField
from mrgs.field.appearance import ColorHead
from mrgs.kernels import color_head, convolution, variation
from mrgs.kernels.blur import cpu as blur
from mrgs.kernels.harmonics import cpu as harmonics
from mrgs.kernels.heat import residuals as heat
from mrgs.kernels.heat.residuals import exchange, with_neighbours
from mrgs.kernels.rasterize.cpu.rasterize import median_depth, rasterize
from mrgs.kernels.ssim import cpu as ssim
from mrgs.rasterizer import Geometry, Layer, Projection
from mrgs_thermonerf.kernels import hash_grid, perceptron
from tests.helpers.gaussians import random_gaussians

N, K, WIDTH = 5, 3, 6

Call = tuple[Callable[..., Any], dict[str, Any]]


def ones(*shape: int) -> Tensor:
    return torch.ones(shape)


def rows(*values: int) -> Tensor:
    return torch.tensor(values, dtype=torch.int64)


def neighbours() -> Tensor:
    return torch.arange(N * K).view(N, K) % N


CALLS: dict[str, Call] = {
    "shade": (
        harmonics.shade,
        {
            "means": ones(N, 3),
            "dc": ones(N, 1, 3),
            "rest": ones(N, 15, 3),
            "camera_position": ones(3),
            "degree": 3,
            "rows": rows(0, 4),
        },
    ),
    "color_residuals": (
        color_head.color_residuals,
        {
            "head": ColorHead(WIDTH, 2, 8, 0.01),
            "embedding": ones(N, WIDTH),
            "means": ones(N, 3),
            "camera_position": 2 * ones(3),
            "rows": rows(0, 4),
        },
    ),
    "exchange": (
        exchange,
        {
            "projected": ones(N, K + 1),
            "opacity": ones(2),
            "constants": ones(3),
            "neighbours": neighbours(),
            "rows": rows(0, 4),
            "weights": (0.9, 0.1),
        },
    ),
    "with_neighbours": (with_neighbours, {"rows": rows(0, 4), "neighbours": neighbours()}),
    "encode": (
        hash_grid.encode,
        {
            "points": ones(N, 3),
            "table": ones(27 + 32, 4),
            "resolutions": rows(2, 5),
            "offsets": rows(0, 27, 59),
        },
    ),
    "perceptron": (
        perceptron.perceptron,
        {
            "inputs": ones(N, 7),
            "hidden_weight": ones(8, 7),
            "hidden_bias": ones(8),
            "output_weight": ones(2, 8),
            "output_bias": ones(2),
        },
    ),
    "photometric_loss": (
        ssim.photometric_loss,
        {
            "render": ones(6, 7, 3),
            "target": ones(6, 7, 3),
            "valid": ones(6, 7).bool(),
            "dssim": 0.2,
        },
    ),
    "boltzmann_loss": (
        ssim.boltzmann_loss,
        {
            "thermal": ones(6, 7),
            "radiation": ones(6, 7),
            "uncertainty": ones(6, 7),
            "valid": ones(6, 7).bool(),
        },
    ),
    "total_variation": (
        variation.total_variation,
        {
            "image": ones(6, 7, 3),
            "valid": ones(6, 7).bool(),
            "row_weights": ones(5, 7),
            "column_weights": ones(6, 6),
        },
    ),
    "convolve": (
        convolution.convolve,
        {"plane": ones(6, 7), "weights": ones(3, 3), "bias": ones(1)},
    ),
    "blur": (blur.blur, {"plane": ones(9, 9), "sigma_px": torch.tensor(0.8)}),
}

WRONG: dict[str, dict[str, list[Any]]] = {
    "shade": {
        "means": [ones(N, 2), ones(N, 3).double()],
        "dc": [ones(N - 1, 1, 3), ones(N, 2, 3)],
        "rest": [ones(N - 1, 15, 3), ones(N, 15, 1)],
        "camera_position": [ones(2), ones(3).double()],
        "rows": [rows(0, N), rows(-1), rows(0, 1).int(), rows(0, 1)[None]],
    },
    "color_residuals": {
        "embedding": [ones(N, WIDTH + 6), ones(N, WIDTH - 1), ones(N - 1, WIDTH)],
        "means": [ones(N - 1, 3), ones(N, 4), ones(N, 3).double()],
        "camera_position": [ones(4)],
        "rows": [rows(0, N), rows(-1)],
    },
    "exchange": {
        "projected": [ones(N, K), ones(N, K + 2), ones(N - 1, K + 1)],
        "opacity": [ones(1), ones(3), ones(2).double()],
        "constants": [ones(2)],
        "neighbours": [neighbours() + 1, neighbours() - 1, neighbours().int()],
        "rows": [rows(0, N), rows(-1, 0)],
    },
    "with_neighbours": {
        "neighbours": [neighbours() + 1, neighbours() - 1],
        "rows": [rows(N), rows(-1)],
    },
    "encode": {
        "points": [ones(N, 2), ones(N, 3).double()],
        "table": [ones(59, 3), ones(58, 4), ones(59, 4).double()],
        "resolutions": [rows(2), rows(2, 5).int()],
        "offsets": [rows(0, 59), rows(-1, 27, 59), rows(0, 60, 59), rows(0, 27, 27)],
    },
    "perceptron": {
        "inputs": [ones(N, 8), ones(N, 7).double()],
        "hidden_weight": [ones(9, 7), ones(8, 6)],
        "hidden_bias": [ones(7), ones(9)],
        "output_weight": [ones(2, 7), ones(3, 8)],
        "output_bias": [ones(1), ones(3)],
    },
    "photometric_loss": {
        "target": [ones(5, 7, 3), ones(6, 7, 1), ones(6, 7, 3).double()],
        "valid": [ones(5, 7).bool(), ones(6, 6).bool()],
    },
    "boltzmann_loss": {
        "radiation": [ones(5, 7), ones(6, 8)],
        "uncertainty": [ones(5, 7)],
        "valid": [ones(5, 7).bool()],
    },
    "total_variation": {
        "image": [ones(6, 7)],
        "valid": [ones(5, 7).bool(), ones(6, 7)],
        "row_weights": [ones(6, 7), ones(5, 7).double()],
        "column_weights": [ones(6, 7), ones(7, 6)],
    },
    "convolve": {"plane": [ones(6, 7, 1)], "weights": [ones(2, 3), ones(9), ones(3, 3).double()]},
    "blur": {"plane": [ones(9)], "sigma_px": [ones(2)]},
}

CASES = [
    pytest.param(name, argument, wrong, id=f"{name}-{argument}-{place}")
    for name, arguments in WRONG.items()
    for argument, values in arguments.items()
    for place, wrong in enumerate(values)
]


@pytest.mark.parametrize("name", CALLS)
def test_the_right_arguments_are_taken(name):
    function, arguments = CALLS[name]
    assert function(**arguments) is not NotImplemented


@pytest.mark.parametrize(("name", "argument", "wrong"), CASES)
def test_other_sizes_types_and_indices_are_refused(name, argument, wrong):
    function, arguments = CALLS[name]
    with pytest.raises((ValueError, IndexError, RuntimeError)):
        function(**{**arguments, argument: wrong})


def test_layers_that_do_not_fit_together_are_refused():
    function, arguments = CALLS["color_residuals"]
    head = ColorHead(WIDTH, 2, 8, 0.01)
    head.mlp[2] = torch.nn.Linear(8, 16)
    with pytest.raises(ValueError, match="colour head's weight 1"):
        function(**{**arguments, "head": head})
    field = RadianceField(FieldConfig(embedding_width=WIDTH, neighbours_n=2))
    gaussians = random_gaussians(N, bands=15, embedding_width=WIDTH)
    assert len(heat.residuals_on_cpu(field, gaussians, neighbours())) == N
    wider = gaussians.with_tensors({**gaussians.tensors(), "embedding": ones(N, 2 * WIDTH)})
    with pytest.raises(ValueError, match="φ_SH's weight 0"):
        heat.residuals_on_cpu(field, wider, neighbours())


def test_there_are_no_harmonics_above_degree_three():
    function, arguments = CALLS["shade"]
    with pytest.raises(ValueError, match="15 bands"):
        function(**{**arguments, "rest": ones(N, 24, 3), "degree": 4})


def test_a_camera_has_its_sizes():
    layer = Layer(ones(2), ones(2, 3), ones(3))
    geometry = Geometry(ones(2, 3), ones(2, 4), ones(2, 3))
    right = Projection(torch.eye(4), torch.eye(3), 8, 8)
    rasterize(geometry, [layer], right)
    for wrong in (
        {"viewmat": torch.eye(3)}, {"K": torch.eye(2)}, {"width": 0}, {"height": -1}
    ):  # fmt: skip
        with pytest.raises(ValueError, match="viewmat"):
            rasterize(geometry, [layer], right._replace(**wrong))
        with pytest.raises(ValueError, match="viewmat"):
            median_depth(geometry, ones(2), right._replace(**wrong))


@pytest.mark.parametrize("sigma", [float("nan"), float("inf"), 1e30, 0.0, -1.0])
def test_a_blur_of_no_width_is_left_to_the_plain_definition(sigma):
    assert blur.blur(ones(9, 9), torch.tensor(sigma)) is NotImplemented
