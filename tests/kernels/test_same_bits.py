from __future__ import annotations

import os
import subprocess
import sys

import pytest

DIGESTS = """
import hashlib
import torch
from mrgs.field.appearance import ColorHead, color_residuals
from mrgs.kernels.heat.thermal_head import project_features


def print_digest(outputs, inputs):
    tensors = [outputs, *torch.autograd.grad(outputs.square().sum(), inputs)]
    content = b"".join(tensor.detach().numpy().tobytes() for tensor in tensors)
    print(hashlib.sha256(content).hexdigest())


torch.manual_seed(0)
torch.set_num_threads(1)
inputs = [torch.randn(2_000, width, requires_grad=True) for width in (24, 3)]
print_digest(color_residuals(ColorHead(24, 4, 64, 1.0), *inputs, torch.zeros(3)), inputs)

inputs = [torch.randn(2_000, *shape, requires_grad=True) for shape in ((24,), (1, 3), (15, 3))]
layers = [torch.randn(*s) for s in ((24, 48), (24,), (64, 84), (64,), (9, 64), (9,))]
positions = torch.rand(2_000, 3)
features = project_features(*inputs, tuple(layers), positions, 10, torch.arange(2_000))
print_digest(features, inputs)
"""


@pytest.mark.slow
def test_a_process_that_compiles_the_heads_computes_the_bits_of_one_that_loads_them(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    digests = [
        subprocess.run(
            [sys.executable, "-c", DIGESTS],
            env=environment, capture_output=True, text=True, check=True,
        ).stdout.split()
        for _ in ("compiles", "loads")
    ]  # fmt: skip
    assert any(tmp_path.rglob("*.nbc"))
    assert digests[0] == digests[1]
    assert len(set(digests[0])) == 2
