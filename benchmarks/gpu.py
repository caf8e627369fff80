"""What the GPU makes of it: ``python -m benchmarks.gpu``, in at most ten minutes.

Needs an NVIDIA GPU, torch with CUDA, Triton and this repository; no network. From the repository's
root, the package need not be installed (``PYTHONPATH=src python -m benchmarks.gpu``). ``--device
cpu`` tries every part at tiny sizes without a GPU; its times say nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks.gpu_plan import PARTS, PLANS
from benchmarks.gpu_report import to_markdown
from mrgs.system.child import child_environment

ROOT = Path(__file__).parents[1]
SECONDS = 570.0
BUILD_SECONDS = 240.0
COMPILATION_SECONDS = 120.0
"""Into the run; a compilation for the scoring that is not done by then goes on beside the parts."""

LEAST_SECONDS = {
    "device": 10.0,
    "correctness": 10.0,
    "gsplat": 20.0,
    "rasterizer": 10.0,
    "step": 10.0,
    "training": 60.0,  # of which the most is kept for the scoring
}
"""A part that has less left is skipped."""

TIMED = ("gsplat", "rasterizer", "step")
"""Parts whose times depend on the host: nothing is compiled beside them."""

END_SECONDS = 10.0
"""A build that was asked to end is killed after so long."""

ERROR = re.compile(r"^(?!\s).*\b(error|fatal)\b[^:]{0,12}:")
"""As compilers, linkers and CUDA mark them; what is indented quotes the source."""

Results = dict[str, Any]


class Budget:
    """The time that is left."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._started = time.perf_counter()

    @property
    def left(self) -> float:
        """Seconds; negative when it is used up."""
        return self.seconds - self.spent

    @property
    def spent(self) -> float:
        """Seconds."""
        return time.perf_counter() - self._started


Children = Callable[..., "subprocess.CompletedProcess[str]"]
"""``subprocess.run``, or what stands in for it."""


def main(
    arguments: Sequence[str] | None = None,
    children: Children = subprocess.run,
    compile_in: Callable[[Path], Beside] | None = None,
) -> int:
    """Measure, write gpu.json and gpu.md, print the tables; 1 if a part failed or a result was
    wrong.

    Args:
        arguments: of the command line.
        children: runs a part.
        compile_in: starts the compilation for the scoring; ``scoring_compilation`` by default.
    """
    options = _parse(arguments)
    options.gsplat = _unpacked(options.gsplat)
    options.output.mkdir(parents=True, exist_ok=True)
    budget = Budget(options.seconds)
    results = _measure(options, budget, children, compile_in or scoring_compilation)
    text = to_markdown(results)
    (options.output / "gpu.md").write_text(text)
    print(text)
    return 1 if is_bad(results) else 0


def _measure(
    options: argparse.Namespace,
    budget: Budget,
    children: Children,
    compile_in: Callable[[Path], Beside],
) -> Results:
    """All parts, one after the other; gpu.json is written after each. Without a device there are no
    parts."""
    plan = "trial" if options.device == "cpu" else "quick" if options.quick else "full"
    parts = kept_parts(options.output / "gpu.json", plan) if options.only else {}
    results: Results = {"plan": plan, "parts": parts}
    with ExitStack() as stack:
        build: GsplatBuild | None = None
        compilation: Beside | None = None
        for part in ("device", *(options.only or PARTS)):
            print(f"{budget.spent:4.0f} s  {part}", flush=True)
            missing = None
            if part == "gsplat":
                limit = min(BUILD_SECONDS - budget.spent, budget.left)
                missing = "needs a GPU" if build is None else build.wait(limit)
            if part in TIMED and compilation is not None:
                compilation.done_within(min(COMPILATION_SECONDS - budget.spent, budget.left))
            parts[part] = (
                {"skipped": missing} if missing else _run(part, plan, options, budget, children)
            )
            results["seconds"] = budget.spent
            (options.output / "gpu.json").write_text(json.dumps(results, indent=1) + "\n")
            if part == "device" and "failed" in parts[part]:
                break
            if part == "device" and options.device == "cuda":
                folder = stack.enter_context(tempfile.TemporaryDirectory())
                compilation = stack.enter_context(compile_in(Path(folder)))
            if part == "device" and _wants_gsplat(options):
                build = GsplatBuild(options.gsplat)
                stack.enter_context(build)
    return results


def kept_parts(file: Path, plan: str) -> dict[str, Any]:
    """What an earlier run of the same plan measured, each part with its device.

    Args:
        file: the results of that run; where there are none, nothing is kept.
        plan: of this run.
    """
    earlier = json.loads(file.read_text()) if file.exists() else {"plan": None}
    if earlier["plan"] != plan:
        return {}
    device = earlier["parts"].pop("device").get("rows", [])
    return {name: {"device": device, **part} for name, part in earlier["parts"].items()}


def is_bad(results: Results) -> bool:
    """Whether a part of this run failed, or a result differs from its oracle."""
    parts = [part for part in results["parts"].values() if "device" not in part]
    rows = [row for part in parts for row in part.get("rows", [])]
    return any("failed" in result or not result.get("ok", True) for result in (*parts, *rows))


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gpu", description="Check and time the GPU kernels."
    )
    parser.add_argument(
        "--quick", action="store_true", help="fewer sizes, a short training: about three minutes"
    )
    parser.add_argument(
        "--only",
        action="append",
        choices=PARTS,
        metavar="PART",
        help=f"{', '.join(PARTS)}; what the results hold of others is kept",
    )
    parser.add_argument(
        "--gsplat",
        type=Path,
        metavar="PATH",
        help="gsplat's wheel, or the folder that holds gsplat/",
    )
    parser.add_argument(
        "--seconds", type=float, default=SECONDS, help="what has not begun by then is skipped"
    )
    parser.add_argument(
        "--device", choices=("cuda", "cpu"), default="cuda", help="cpu: a trial at tiny sizes"
    )
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results")
    return parser.parse_args(arguments)


def _wants_gsplat(options: argparse.Namespace) -> bool:
    return options.device == "cuda" and (not options.only or "gsplat" in options.only)


def _unpacked(gsplat: Path | None, under: Path | None = None) -> Path | None:
    """The folder that holds gsplat; a wheel is unpacked where the next run finds it, with what was
    built of it: under the system's temporary folder, or the given one."""
    if gsplat is None or gsplat.is_dir():
        return gsplat
    folder = (under or Path(tempfile.gettempdir())) / f"mrgs-{gsplat.stem}"
    if not folder.exists():
        with zipfile.ZipFile(gsplat) as wheel:
            wheel.extractall(folder)
    return folder


def _run(
    part: str, plan: str, options: argparse.Namespace, budget: Budget, children: Children
) -> dict[str, Any]:
    """The part's rows and seconds; with why there are none, or no more, if it was "skipped" or
    "failed"."""
    started, rows, result = budget.spent, [], {}
    for method in PLANS[plan].trainings if part == "training" else ("",):
        if budget.left < LEAST_SECONDS[part]:
            result["skipped"] = f"{max(budget.left, 0):.0f} s of {budget.seconds:.0f} s were left"
            break
        found = _child(part, plan, options, budget.left, method, children)
        rows += found.pop("rows")
        result |= found
    return {"rows": rows, "seconds": budget.spent - started, **result}


def _child(
    part: str,
    plan: str,
    options: argparse.Namespace,
    seconds: float,
    method: str,
    children: Children,
) -> dict[str, Any]:
    """The rows that a process of its own leaves of a part, or of a method's training."""
    result: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rows.json"
        request = {
            "part": part,
            "plan": plan,
            "device": options.device,
            "until": time.time() + seconds,
            "method": method,
            "file": str(file),
        }
        command = [sys.executable, "-m", "benchmarks.gpu_part", json.dumps(request)]
        try:
            child = children(
                command,
                env=environment(options.gsplat),
                stderr=subprocess.PIPE,
                text=True,
                timeout=seconds,
            )
        except subprocess.TimeoutExpired:
            result["skipped"] = f"not done after {seconds:.0f} s"
        else:
            if child.returncode != 0:
                result["failed"] = reason(child.stderr, child.returncode)
                print(child.stderr, file=sys.stderr)
        rows = json.loads(file.read_text()) if file.exists() else []
    return {"rows": rows, **result}


def environment(gsplat: Path | None) -> dict[str, str]:
    """Of the child processes: they find the benchmarks, the package and gsplat, whatever folder
    this runs in."""
    paths = [
        os.environ.get("PYTHONPATH", ""),
        str(ROOT),
        str(ROOT / "src"),
        *([str(gsplat)] if gsplat else []),
    ]
    found = child_environment(PYTHONPATH=os.pathsep.join(filter(None, paths)))
    found.pop(
        "TRITON_INTERPRET", None
    )  # interpreted on the CPU, the kernels would be measured in minutes
    return found


def reason(stderr: str, returncode: int) -> str:
    """Why a process failed: its last three errors; if it names none, its last line."""
    lines = stderr.strip().splitlines() or [f"exit status {returncode}"]
    return "; ".join([line.strip() for line in lines if ERROR.match(line)][-3:] or lines[-1:])


def scoring_compilation(folder: Path) -> Beside:
    """The CPU's kernels, which score what was trained, compiled by a training of three steps: the
    first one on a machine takes a minute.

    Args:
        folder: for what it writes.
    """
    request = {"part": "training", "plan": "trial", "device": "cpu", "method": "mrgs"}
    request |= {"until": time.time() + SECONDS, "file": str(folder / "rows.json")}
    return Beside(["-m", "benchmarks.gpu_part", json.dumps(request)], environment(None))


class Beside:
    """A process beside the first parts; ended with those that it has started when this is left.

    Args:
        arguments: of Python.
        variables: of the environment.
    """

    def __init__(self, arguments: Sequence[str], variables: Mapping[str, str]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, *arguments], env=dict(variables), stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE, text=True, start_new_session=True,
        )  # fmt: skip
        self._errors = ""

    def __enter__(self) -> Beside:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def done_within(self, seconds: float) -> bool:
        """Wait for the process, but not longer than this; whether it is done."""
        try:
            self._errors = self._process.communicate(timeout=max(seconds, 1.0))[1]
        except subprocess.TimeoutExpired:
            return False
        return True

    def stop(self, patience_s: float = END_SECONDS) -> None:
        """End the process, if it is not done; it is killed if it has not ended when asked."""
        if self._process.poll() is None:
            # Not killed at once: ninja, which builds gsplat, gives each compiler a group of its
            # own, and ends them when it is asked to end.
            os.killpg(self._process.pid, signal.SIGTERM)
            try:
                self._process.communicate(timeout=patience_s)
            except subprocess.TimeoutExpired:
                os.killpg(self._process.pid, signal.SIGKILL)
        self._process.communicate()


class GsplatBuild(Beside):
    """gsplat's kernels, built beside the first parts.

    Args:
        source: a folder that holds gsplat, or its wheel; None for the installed one.
        arguments: of Python, which builds it.
    """

    def __init__(
        self, source: Path | None, arguments: Sequence[str] = ("-m", "benchmarks.gpu_gsplat")
    ) -> None:
        self._path = os.pathsep.join(["src", *([str(source)] if source else [])])
        jobs = {"MAX_JOBS": str(max(1, (os.cpu_count() or 1) - 2))}
        super().__init__(arguments, environment(source) | jobs)

    def wait(self, seconds: float) -> str | None:
        """Until the build is done; why there is none, otherwise. A build that is not done in time
        is ended."""
        if not self.done_within(seconds):
            self.stop()
            return (
                "gsplat's kernels were not built in time: build them first "
                f"(PYTHONPATH={self._path} python -m benchmarks.gpu_gsplat), then run this again "
                f"on the same machine"
            )
        if self._process.returncode != 0:
            return f"gsplat cannot be used ({reason(self._errors, self._process.returncode)})"
        return None


if __name__ == "__main__":
    sys.exit(main())
