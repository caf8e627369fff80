"""Compile the Numba kernels once, before several test processes would each compile them.

The compiled kernels are kept on disk (``mrgs.kernels.cache``); where they are kept already, this
takes some seconds.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import mrgs

SCENE = Path(__file__).parents[1] / "examples" / "tabletop"
METHODS = ("mrgs-plus", "mrgs", "thermonerf")
"""Between them, these run every kernel."""

if __name__ == "__main__":
    for method in METHODS:
        with tempfile.TemporaryDirectory() as folder:
            options = mrgs.make_config(method, max_steps=2, max_gaussians=300)
            mrgs.train(SCENE, Path(folder) / "run", options)
