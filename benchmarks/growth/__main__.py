"""Measure how cost grows, and write tables, chart and JSON: ``python -m benchmarks.growth``."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.__main__ import machine
from benchmarks.growth.plan import GROUPS, SMALLEST, Case, case_from_json, case_to_json
from benchmarks.growth.report import Row, draw, to_markdown
from benchmarks.processes import ROOT
from mrgs.system.child import Child

CHILD = ("-m", "benchmarks.growth.child")


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what the output folder lacks, and write the report; 1 if a case failed."""
    options = _parse(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    store = options.output / "growth.json"
    rows = {row.case: row for row in _read(store)}
    cases = [case for name in options.only or GROUPS for case in GROUPS[name]]
    missing = [case for case in cases if case not in rows]
    for method in dict.fromkeys(case.method for case in missing):
        measure(Case("estimate", 1_000, photos=2, size=SMALLEST, method=method))  # compiles
    failed = 0
    for number, case in enumerate(missing, start=1):
        found = measure(case)
        print(f"{number}/{len(missing)} {case} {found}", flush=True)
        if "failed" in found:
            failed = 1
            continue
        rows[case] = Row(case, **found)
        ordered = [rows[case] for group in GROUPS.values() for case in group if case in rows]
        _write(ordered, options.output)
    return failed


def measure(case: Case) -> dict[str, Any]:
    """The result of a case, from a process of its own; or the reason why there is none."""
    threads = str(case.threads)
    paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH", ""))))
    with TemporaryDirectory() as folder:
        child = Child(
            CHILD,
            {"case": case_to_json(case)},
            Path(folder) / "log.txt",
            PYTHONPATH=paths,
            OMP_NUM_THREADS=threads,
            NUMBA_NUM_THREADS=threads,
        )
        try:
            for _ in child.messages():
                pass
        finally:
            child.close()
        reason = child.failure()
    result: dict[str, Any] = {"failed": reason} if reason is not None else child.end["result"]
    return result


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.growth",
        description="Processor time and memory of trainings over Gaussians, photos, pixels and "
        "threads, and the estimate of the memory. What the output folder holds is not measured "
        "again.",
    )
    parser.add_argument("--only", action="append", choices=GROUPS, metavar="GROUP")
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "results" / "growth")
    return parser.parse_args(arguments)


def _read(store: Path) -> list[Row]:
    if not store.exists():
        return []
    entries = json.loads(store.read_text(encoding="utf-8"))["rows"]
    return [Row(**{**entry, "case": case_from_json(entry["case"])}) for entry in entries]


def _write(rows: Sequence[Row], folder: Path) -> None:
    """growth.json, growth.md and growth.png."""
    facts = machine(max(row.case.threads for row in rows))
    entries = [{**row._asdict(), "case": case_to_json(row.case)} for row in rows]
    content = json.dumps({"machine": facts, "rows": entries}, indent=1) + "\n"
    (folder / "growth.json").write_text(content, encoding="utf-8")
    text = to_markdown(rows, facts)
    try:
        draw(rows, folder / "growth.png")
        text += "\n![Processor time and memory over what grows](growth.png)\n"
    except ImportError as error:
        text += f'\nNo chart: {error}; `pip install -e ".[bench]"`\n'
    (folder / "growth.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
