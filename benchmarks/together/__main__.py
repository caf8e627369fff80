"""Several processes beside one with as many views a step: ``python -m benchmarks.together SCENE``.

Each number of processes trains the scene with as many views as the others have: once by torchrun,
once in one process with ``--batch``. Prints whether both have the same bits, what a process sends
in a step, the processor time of the parts of a step, and scores. With the right to make a network
namespace, the bytes on its loopback device are counted too.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file

from benchmarks.processes import ROOT
from benchmarks.quality.child import scores_of
from mrgs import open_run
from mrgs.evaluation import evaluate_run
from mrgs.training.run_folder import RunFolder

CHILD = "benchmarks.together.child"
PARTS = ("views", "exchange", "Adam", "density")
IN_NAMESPACE = ("unshare", "-n", "sh", "-c", 'ip link set lo up && exec "$@"', "sh")
COLUMNS = (
    "processes", "steps", "same bits", "MB sent", "MB on the device",
    f"ms of {', '.join(PARTS)}, rest", "thermal", "RGB", "error",
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Train and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.together")
    parser.add_argument("scene", type=Path)
    parser.add_argument("--counts", nargs="+", type=int, default=[1, 2, 4, 8])
    parser.add_argument("--views", type=int, default=1000)
    parser.add_argument("--max-gaussians", type=int, default=8000)
    parser.add_argument("--method", default="mrgs-plus")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--one-process", action="store_true", help="leave torchrun out")
    options = parser.parse_args(arguments)
    print(f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|", flush=True)
    for count in options.counts:
        with tempfile.TemporaryDirectory(prefix="mrgs-together-") as folder:
            print(_row(options, count, Path(folder)), flush=True)


def _row(options: argparse.Namespace, count: int, folder: Path) -> str:
    """A line of the table."""
    one, several = folder / "one", folder / "several"
    figures = _train(options, count, one, 1)
    same = "–"
    if count > 1 and not options.one_process:
        figures = _train(options, count, several, count)
        same = "yes" if _have_same_bits(one, several) else "no"
    steps, seconds = figures[0]["steps"], figures[0]["seconds"]
    rest = seconds["step"] - sum(seconds.get(part, 0.0) for part in PARTS)
    spent = [1e3 * each / steps for each in (*(seconds.get(part, 0.0) for part in PARTS), rest)]
    sent = max(each["sent"] for each in figures) / steps / 1e6
    on_device = figures[0]["loopback"] / steps / count / 1e6
    evaluate_run(open_run(one))
    metrics = json.loads((one / "eval/metrics.json").read_text(encoding="utf-8"))
    scores = scores_of(metrics)
    return (
        f"| {count} | {options.views // count:,} | {same} | {sent:.2f} | {on_device:.2f} | "
        f"{', '.join(f'{each:.1f}' for each in spent)} | {scores['thermal']:.2f} dB | "
        f"{scores['rgb']:.2f} dB | {scores.get('error', float('nan')):.3f} |"
    )


def _train(
    options: argparse.Namespace, batch: int, output: Path, processes: int
) -> list[dict[str, Any]]:
    """Train; what each process has counted."""
    found = output.with_name(f"{output.name}-figures")
    found.mkdir()
    start = [sys.executable, "-m"]
    if processes > 1:
        start += ["torch.distributed.run", "--standalone", f"--nproc-per-node={processes}", "-m"]
        start = [*(IN_NAMESPACE if os.geteuid() == 0 else ()), *start]
    command = (
        *start, CHILD, found, "train", options.scene, "--output", output, "--batch", batch,
        "--preset", "fast", "--max-steps", options.views // batch, "--method", options.method,
        "--max-gaussians", options.max_gaussians, "--seed", options.seed,
    )  # fmt: skip
    variables = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
    variables["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    subprocess.run(
        list(map(str, command)), env={**os.environ, **variables}, check=True,
        stdout=subprocess.DEVNULL,
    )  # fmt: skip
    files = sorted(found.glob("*.json"), key=lambda path: int(path.stem))
    return [json.loads(path.read_text(encoding="utf-8")) for path in files]


def _have_same_bits(*runs: Path) -> bool:
    first, second = (load_file(RunFolder(run).newest_checkpoint()) for run in runs)
    return first.keys() == second.keys() and all(
        torch.equal(tensor, second[name]) for name, tensor in first.items()
    )


if __name__ == "__main__":
    main()
