from __future__ import annotations

import os
import subprocess
import sys

import pytest

COLOR_RESIDUALS = """
import torch
from mrgs.field.appearance import ColorHead, color_residuals

torch.manual_seed(0)
torch.set_num_threads(1)
head = ColorHead(24, 4, 64, 1.0)
inputs = [torch.randn(2_000, width, requires_grad=True) for width in (24, 3)]
residuals = color_residuals(head, *inputs, torch.zeros(3))
"""

TEMPERATURE_RESIDUALS = """
import torch
from mrgs.kernels.heat.thermal_head import project_features

torch.manual_seed(0)
torch.set_num_threads(1)
inputs = [torch.randn(2_000, *shape, requires_grad=True) for shape in ((24,), (1, 3), (15, 3))]
layers = [torch.randn(*s) for s in ((24, 48), (24,), (64, 84), (64,), (9, 64), (9,))]
positions = torch.rand(2_000, 3)
residuals = project_features(*inputs, tuple(layers), positions, 10, torch.arange(2_000))
"""

PRINT_DIGEST = """
import hashlib

tensors = [residuals, *torch.autograd.grad(residuals.square().sum(), inputs)]
print(hashlib.sha256(b"".join(tensor.detach().numpy().tobytes() for tensor in tensors)).hexdigest())
"""


@pytest.mark.parametrize("program", [COLOR_RESIDUALS, TEMPERATURE_RESIDUALS])
def test_a_process_that_compiles_the_heads_computes_the_bits_of_one_that_loads_them(
    program, tmp_path
):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    digests = [
        subprocess.run(
            [sys.executable, "-c", program + PRINT_DIGEST],
            env=environment, capture_output=True, text=True, check=True,
        ).stdout
        for _ in ("compiles", "loads")
    ]  # fmt: skip
    assert any(tmp_path.rglob("*.nbc"))
    assert digests[0] == digests[1] != ""
