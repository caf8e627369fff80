"""Compile the Numba kernels once, before several test processes would each compile them.

``python tools/compile_kernels.py STAMP`` touches the file STAMP when all are compiled. They are
kept on disk (``mrgs.kernels.cache``); where they are kept already, this takes some seconds.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from filelock import FileLock

SCENE = Path(__file__).parents[1] / "examples" / "tabletop"

SMALL = ("--max-steps", "2", "--resolution", "32")
"""Steps and photos so small that nearly all of their time is compiling."""


def differentiate_published() -> None:
    """Colours, temperatures and ψ as published, and their gradients: what mrgs-plus does not call.
    Without the rasterizer, which it compiles at the same time."""
    import torch

    from mrgs.field import FieldConfig, RadianceField
    from mrgs.method.losses.radiation import convolve
    from mrgs.scene import RGB, THERMAL, Gaussians

    field, rows, camera = RadianceField(FieldConfig()), torch.arange(50), torch.zeros(3)
    means, quats, scales, radiation = (torch.randn(len(rows), n) for n in (3, 4, 3, 50))
    gaussians = Gaussians(
        means, quats, scales,
        opacity_logits={modality: torch.zeros(len(rows), 1) for modality in (RGB, THERMAL)},
        sh_dc={RGB: torch.randn(len(rows), 1, 3), THERMAL: torch.randn(len(rows), 1, 1)},
        sh_rest={RGB: torch.randn(len(rows), 15, 3), THERMAL: torch.randn(len(rows), 0, 1)},
        embedding=field.initial_embedding(means),
    )  # fmt: skip
    neighbours = field.neighbours_of(means)
    for tensor in (*gaussians.tensors().values(), radiation):
        tensor.requires_grad_()
    colors = field.colors(gaussians, camera, 3, rows)
    temperatures = field.temperatures(gaussians, neighbours, camera, 3, rows)
    psi = convolve(radiation, torch.ones(3, 3), torch.zeros(1))
    (colors.sum() + temperatures.sum() + psi.sum()).backward()


def run(*commands: tuple[str, ...]) -> None:
    """Run Python with these arguments, one after another, in silence. CalledProcessError if one
    fails."""
    for arguments in commands:
        subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)


def training(method: str, output: str) -> tuple[str, ...]:
    """The command that trains a method for some steps."""
    return ("-m", "mrgs", "train", str(SCENE), "--method", method, *SMALL, "--output", output)


def compile_kernels(stamp: Path) -> None:
    """In two processes, which share few kernels; not if another did so while this one waited."""
    began = time.time()
    with FileLock(f"{stamp}.lock"), tempfile.TemporaryDirectory() as runs:
        if stamp.exists() and stamp.stat().st_mtime > began:
            return
        plus, baseline = f"{runs}/mrgs-plus", f"{runs}/thermonerf"
        with ThreadPoolExecutor(2) as pool:
            chains = (
                pool.submit(run, training("mrgs-plus", plus), ("-m", "mrgs", "eval", plus)),
                pool.submit(run, (__file__,), training("thermonerf", baseline)),
            )
        for chain in chains:
            chain.result()
        stamp.touch()


if __name__ == "__main__":
    if len(sys.argv) > 1:
        compile_kernels(Path(sys.argv[1]))
    else:
        differentiate_published()
