"""Measure all stages and write a report: ``python -m benchmarks --quick``."""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks import chart
from benchmarks.plan import GROUPS, QUICK_EFFORT, Effort
from benchmarks.processes import measure_case, warm_up
from benchmarks.report import to_markdown


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, write the report into the output folder; 1 if a case failed."""
    options = _parse(arguments)
    groups = options.only or list(GROUPS)
    started = time.perf_counter()
    print("compiling", flush=True)
    warm_up(groups, options.threads)
    cases = [case for name in groups for case in GROUPS[name].cases(options.quick)]
    effort = QUICK_EFFORT if options.quick else Effort()
    results: dict[str, Any] = {
        "machine": machine(options.threads),
        "quick": options.quick,
        "cases": [],
    }
    for number, case in enumerate(cases, start=1):
        size = " ".join(
            str(value) for value in (case.gaussians, case.width, case.height) if value is not None
        )
        print(f"{number}/{len(cases)} {case.group} {size}", flush=True)
        results["cases"].append(measure_case(case, effort, options.threads))
    _write(results, options.output)
    print(f"{options.output}/results.md, after {(time.perf_counter() - started) / 60:.1f} minutes")
    failed = [case for case in results["cases"] if "failed" in case]
    for case in failed:
        print(f"failed: {case['group']}: {case['failed']}", file=sys.stderr)
    return 1 if failed else 0


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description="Time every stage of a training step."
    )
    parser.add_argument("--quick", action="store_true", help="two sizes and fewer runs")
    parser.add_argument(
        "--only", action="append", choices=GROUPS, metavar="STAGE", help=", ".join(GROUPS)
    )
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results")
    return parser.parse_args(arguments)


def machine(threads: int) -> dict[str, Any]:
    """What ran the benchmark."""
    versions = {
        name: importlib.metadata.version(name) for name in ("torch", "numba", "numpy", "mrgs")
    }
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": threads,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **versions,
    }


def _processor() -> str:
    """The processor's name, as well as the system knows it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _write(results: dict[str, Any], folder: Path) -> None:
    """results.json, results.md and, with matplotlib, chart.png."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    markdown = to_markdown(results)
    try:
        chart.draw(results["cases"], folder / "chart.png")
        markdown += "\n![Cost over the number of Gaussians and of pixels](chart.png)\n"
    except ImportError as error:
        markdown += f'\nNo chart: {error}; `pip install -e ".[bench]"`\n'
    (folder / "results.md").write_text(markdown)


if __name__ == "__main__":
    sys.exit(main())
