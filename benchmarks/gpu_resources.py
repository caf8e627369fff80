"""Registers, spills and shared memory of every Triton kernel, compiled for sm_80 and sm_90 on any
machine.

    python -m benchmarks.gpu_resources            compare with the table; exit 1 if it got worse
    python -m benchmarks.gpu_resources --update   rewrite the table for the installed Triton

Each Triton version has its own compiler, and so its own part of the table; docs/gpu.md shows that
of the newest. Another version is measured by putting it first: ``PYTHONPATH=FOLDER_WITH_TRITON
python -m benchmarks.gpu_resources``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks.report import table
from mrgs.system.child import child_environment

ROOT = Path(__file__).parents[1]
TABLE = Path(__file__).parent / "results" / "gpu_resources.json"
SOURCES = TABLE.with_name("gpu_sources.json")
"""Digests of what the kernels of the table were compiled from, by Triton's version."""

DOCUMENT = ROOT / "docs" / "gpu.md"
MARKS = ("<!-- kernels: begin -->", "<!-- kernels: end -->")
UPDATE = "python -m benchmarks.gpu_resources --update"
TIMEOUT_S = 900

TARGETS = {"sm_80": 80, "sm_90": 90}
"""Compute capability of the A100, and of H100 and H200; most RTX cards lie between."""

LIMITED = {
    "registers": "registers per thread",
    "spill_stores": "bytes of spill stores",
    "spill_loads": "bytes of spill loads",
    "stack": "bytes of stack",
    "shared": "bytes of shared memory",
}
"""What a change must not raise unseen."""

REGISTERS_PER_SM = 65_536
WARPS_PER_SM = 64
PROGRAMS_PER_SM = 32
SHARED_PER_SM = {"sm_80": 164 * 1024, "sm_90": 228 * 1024}
SHARED_RESERVED = 1024
"""What the driver takes of each program's shared memory."""

Resources = Mapping[str, int]
Kernels = Mapping[str, Mapping[str, Resources]]
"""Resources by the kernel's name and the target."""


class CompilationError(Exception):
    """The kernels cannot be compiled; the message is the compiler's."""


def compile_in_children(
    known: Mapping[str, Kernels] | None = None,
    child: Callable[..., dict[str, Any]] | None = None,
    sources: Path = SOURCES,
) -> dict[str, Any]:
    """Triton's version, the resources of every specialisation by its name and target, the digests
    of their sources, and the unlisted kernels.

    Each target in a process of its own, which compiles, while this one may have Triton interpret.

    Args:
        known: the committed table, by Triton's version; of kernels whose sources have not changed
            since it was written, its resources are returned. None compiles all.
        child: answers as ``benchmarks.gpu_compile`` does, which it starts by default.
        sources: file of the table's digests.

    Raises:
        CompilationError: a kernel cannot be compiled, or its list does not fit it.
    """
    child = child or _child
    found = child("sources")
    old = (known or {}).get(found["triton"], {})
    digests = _read(sources).get(found["triton"], {})
    kernels = {
        name: old[name]
        for name, digest in found["sources"].items()
        if name in old and digests.get(name) == digest
    }
    changed = [name for name in found["sources"] if name not in kernels]
    if changed:
        with ThreadPoolExecutor() as pool:
            compiled = pool.map(lambda target: child(str(target), *changed), TARGETS.values())
            by_target = dict(zip(TARGETS, compiled, strict=True))
        kernels |= {
            name: {target: by_target[target][name] for target in TARGETS} for name in changed
        }
    return {**found, "kernels": kernels}


def _child(*arguments: str) -> dict[str, Any]:
    """What ``benchmarks.gpu_compile`` prints."""
    with (
        tempfile.TemporaryDirectory() as cache
    ):  # what Triton finds in its cache it does not compile
        child = subprocess.run(
            [sys.executable, "-m", "benchmarks.gpu_compile", *arguments],
            env=environment(cache), capture_output=True, text=True, timeout=TIMEOUT_S,
        )  # fmt: skip
    if child.returncode != 0:
        raise CompilationError(child.stderr.strip() or f"exit status {child.returncode}")
    found: dict[str, Any] = json.loads(child.stdout)
    return found


def environment(cache: str) -> dict[str, str]:
    """Of the children: of Triton's variables, none that is set here, but its cache's folder and
    what the measurement asks for."""
    paths = [os.environ.get("PYTHONPATH", ""), str(ROOT / "src"), str(ROOT)]
    variables = child_environment(PYTHONPATH=os.pathsep.join(filter(None, paths)))
    return {key: value for key, value in variables.items() if not key.startswith("TRITON_")} | {
        "TRITON_CACHE_DIR": cache,
        "TRITON_DUMP_PTXAS_LOG": "1",
        "TRITON_DEFAULT_FP_FUSION": "1",
    }


def worsened(found: Mapping[str, Any], tables: Mapping[str, Kernels]) -> list[str]:
    """One line for everything in which the kernels are worse than the table, or than they may be
    without one.

    Args:
        found: what ``compile_in_children`` returned.
        tables: the committed table, by Triton's version; of a version without one, nothing may
            spill.
    """
    lines = [
        f"{name} is in no KERNELS: list every specialisation that is launched"
        for name in found["unlisted"]
    ]
    known = tables.get(found["triton"])
    if known is None:
        return lines + _spilling(found["kernels"])
    for name, targets in found["kernels"].items():
        if name not in known:
            lines.append(f"{name} is not in the table: {UPDATE}")
            continue
        for target, new in targets.items():
            lines += _raised(f"{name} for {target}", known[name][target], new)
    gone = sorted(known.keys() - found["kernels"].keys())
    return lines + [f"{name} is in the table, but no longer listed: {UPDATE}" for name in gone]


def _spilling(kernels: Kernels) -> list[str]:
    return [
        f"{name} for {target} spills {new['spill_stores']} bytes"
        for name, targets in kernels.items()
        for target, new in targets.items()
        if new["spill_stores"] > 0
    ]


def _raised(what: str, old: Resources, new: Resources) -> list[str]:
    return [
        f"{what} takes {new[key]} {title}, and took {old[key]}; if that is meant: {UPDATE}"
        for key, title in LIMITED.items()
        if new[key] > old[key]
    ]


def resident_warps(target: str, taken: Resources) -> int:
    """Warps that a multiprocessor can hold of a kernel, of at most 64: what hides the time of its
    loads."""
    warps = taken["warps"]
    registers = -(-taken["registers"] // 8) * 8  # handed out to a warp by 8 per thread
    by_registers = REGISTERS_PER_SM // (registers * 32) // warps
    by_shared = SHARED_PER_SM[target] // (taken["shared"] + SHARED_RESERVED)
    return min(by_registers, by_shared, WARPS_PER_SM // warps, PROGRAMS_PER_SM) * warps


def to_markdown(version: str, kernels: Kernels) -> str:
    """A row per specialisation, and in each cell sm_80 / sm_90 where they differ."""
    header = [
        "kernel",
        "warps",
        "registers",
        "spilled bytes",
        "shared memory, bytes",
        "warps per SM",
    ]
    rows = [[f"`{name}`", *_cells(targets)] for name, targets in sorted(kernels.items())]
    return f"Triton {version}, sm_80 / sm_90:\n\n{table(header, rows)}"


def _cells(targets: Mapping[str, Resources]) -> list[str]:
    columns = [
        [taken["warps"] for taken in targets.values()],
        [taken["registers"] for taken in targets.values()],
        [taken["spill_stores"] for taken in targets.values()],
        [taken["shared"] for taken in targets.values()],
        [resident_warps(target, taken) for target, taken in targets.items()],
    ]
    return [" / ".join(f"{value:,}" for value in dict.fromkeys(column)) for column in columns]


def with_newest(document: str, kernels: Mapping[str, Kernels]) -> str:
    """The document with the newest version's part of the table between the two marks."""
    before, rest = document.split(MARKS[0])
    after = rest.split(MARKS[1])[1]
    newest = max(kernels, key=lambda version: [int(part) for part in version.split(".")])
    return f"{before}{MARKS[0]}\n\n{to_markdown(newest, kernels[newest])}\n\n{MARKS[1]}{after}"


def read_table(path: Path = TABLE) -> dict[str, Kernels]:
    """The committed table, by Triton's version."""
    return _read(path)


def update(
    found: Mapping[str, Any],
    table: Path = TABLE,
    sources: Path = SOURCES,
    document: Path = DOCUMENT,
) -> None:
    """Write what ``compile_in_children`` returned over what the files hold of the same Triton."""
    known = {**read_table(table), found["triton"]: found["kernels"]}
    _write(table, known)
    _write(sources, {**_read(sources), found["triton"]: found["sources"]})
    text = with_newest(document.read_text(encoding="utf-8"), known)
    document.write_text(text, encoding="utf-8")


def _read(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    return found


def _write(path: Path, values: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(values, indent=1, sort_keys=True) + "\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Compile, compare or update, print the table; 1 if anything got worse."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gpu_resources", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "--update", action="store_true", help="rewrite the table for the installed Triton"
    )
    options = parser.parse_args(arguments)
    found = compile_in_children()
    if options.update:
        update(found)
    print(to_markdown(found["triton"], found["kernels"]))
    lines = worsened(found, read_table())
    for line in lines:
        print(line, file=sys.stderr)
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
