"""Peak memory of the exports of a large model: ``python -m benchmarks.export_memory RUN``.

The trained model is enlarged first: each Gaussian is replaced by as many smaller ones as it takes,
drawn from it. Each format is then exported by a process of its own. Prints a table.
"""

from __future__ import annotations

import argparse
import io
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.memory import peak_bytes
from mrgs.app import cli
from mrgs.export.formats import FORMATS
from mrgs.run_files.checkpoint import read, write_file
from mrgs.run_files.folder import RunFolder
from mrgs.scene.rotations import matrix_from_quaternion

CHILD = "import sys; from benchmarks.export_memory import export_alone; export_alone(*sys.argv[1:])"


def main(arguments: Sequence[str] | None = None) -> int:
    """Enlarge, export and print; 1 if an export failed."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.export_memory", description="Peak memory of exports."
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--gaussians", type=int, default=2_000_000)
    parser.add_argument("--formats", nargs="+", default=list(FORMATS))
    options = parser.parse_args(arguments)
    failed = 0
    print("| format | peak memory | files | processor time |\n|---|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as folder:
        large = enlarged(options.run, Path(folder) / "run", options.gaussians)
        for name in options.formats:
            print(f"| {name} |", end=" ", flush=True)
            failed |= subprocess.run([sys.executable, "-c", CHILD, str(large), name]).returncode
            shutil.rmtree(large / "export", ignore_errors=True)
    return failed


def export_alone(run: str, name: str) -> None:
    """Export one format in this process, and print its peak memory, the files and the time."""
    with redirect_stdout(io.StringIO()):
        status = cli.main(["export", str(run), "--format", name])
    size = sum(path.stat().st_size for path in Path(run, "export").rglob("*") if path.is_file())
    print(f"{peak_bytes() / 1e9:.2f} GB | {size / 1e6:.0f} MB | {time.process_time():.0f} s |")
    sys.exit(status)


def enlarged(run: Path, target: Path, count: int) -> Path:
    """A copy of a run whose newest checkpoint has ``count`` Gaussians; returns its folder."""
    source = RunFolder(run)
    file = source.newest_checkpoint()
    tensors, _, header = read(file)
    (target / "checkpoints").mkdir(parents=True)
    shutil.copy(source.config_file, target)
    header = {name: value for name, value in header.items() if name != "format"}
    write_file(target / "checkpoints" / file.name, multiplied(tensors, count), header)
    return target


def multiplied(tensors: Mapping[str, Tensor], count: int) -> dict[str, Tensor]:
    """A checkpoint's tensors with ``count`` Gaussians: copies whose centres are drawn from the
    original, so much smaller that they cover the same surface."""
    means, log_scales = tensors["gaussians.means"], tensors["gaussians.log_scales"]
    rows = torch.arange(count) * len(means) // count
    large = {
        name: tensor[rows] if tensor.shape[:1] == means.shape[:1] else tensor
        for name, tensor in tensors.items()
    }
    normal = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    offsets = log_scales.exp()[rows] * normal
    rotations = torch.from_numpy(matrix_from_quaternion(tensors["gaussians.quats"])).float()
    large["gaussians.means"] = means[rows] + torch.einsum("nij,nj->ni", rotations[rows], offsets)
    large["gaussians.log_scales"] = log_scales[rows] - 0.5 * torch.tensor(count / len(means)).log()
    return large


if __name__ == "__main__":
    sys.exit(main())
