"""A run's figures as markdown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks.plan import GROUPS
from benchmarks.prototype import (
    ADAM,
    CPP_MS,
    MLP,
    NUMBA_MS,
    SSIM_CONV,
    SSIM_SHIFTED,
    Size,
    estimate,
    factor,
    known_ms,
)
from benchmarks.targets import TARGETS

CALIBRATIONS = ("calibration: arithmetic", "calibration: memory")

LOADED = 1.25
"""From this load on, a comparison with another machine is left open."""

FULL_RUNS = 10
"""A median of fewer runs is marked."""

Result = dict[str, Any]


def to_markdown(results: Result) -> str:
    """The whole report."""
    cases = with_load(results["cases"])
    parts = [_head(results["machine"]), _targets(cases), _prototype(cases)]
    parts += [_group(name, [case for case in cases if case["group"] == name]) for name in GROUPS]
    return "\n\n".join(part for part in parts if part) + "\n"


def with_load(cases: Sequence[Result]) -> list[Result]:
    """The cases with their "load": the calibration's time over its least time in the run, the mean
    of both kernels."""
    measured = [case for case in cases if "timings" in case]
    least = {
        name: min((case["timings"][name]["median_ms"] for case in measured), default=1.0)
        for name in CALIBRATIONS
    }
    return [
        {
            **case,
            "load": sum(case["timings"][name]["median_ms"] / least[name] for name in CALIBRATIONS)
            / 2,
        }
        if case in measured
        else case
        for case in cases
    ]


def milliseconds(summary: Result) -> str:
    """A median with three significant digits at most, and the number of runs if there were few."""
    value = summary["median_ms"]
    digits = 2 if value < 1 else 1 if value < 10 else 0
    runs = f" ({summary['runs']})" if summary["runs"] < FULL_RUNS else ""
    return f"{value:,.{digits}f}{runs}"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _head(machine: Result) -> str:
    software = ", ".join(f"{name} {machine[name]}" for name in ("python", "torch", "numba"))
    return (
        "# Benchmark\n\n"
        f"{machine['processor']}, {machine['threads']} threads of {machine['cores']} cores; "
        f"{software}.\n\n"
        "Medians in milliseconds; a number in brackets is that of the runs, where they were fewer "
        "than "
        f"{FULL_RUNS}. Quartiles and least times are in `results.json`. *Load* is the time of two "
        f"fixed kernels, timed "
        "in turns with the stages, over their least time in this report: at 1.2 the machine was "
        "20 % slower than at "
        "its best. *Peak* is the largest resident memory of a process that ran this case alone, "
        "above the interpreter "
        "with torch loaded."
    )


def _targets(cases: Sequence[Result]) -> str:
    rows = []
    for target in TARGETS:
        value = target.value(cases)
        unit = "GB" if target.timing is None else "ms"
        if value is not None:
            digits = 2 if unit == "GB" else 0
            verdict = "met" if value <= target.limit else "missed"
            rows.append(
                [
                    target.title,
                    f"{value:.{digits}f} {unit}",
                    f"{target.limit:.{digits}f} {unit}",
                    verdict,
                ]
            )
    return (
        "## Targets, on 2 threads\n\n" + table(["", "measured", "at most", ""], rows)
        if rows
        else ""
    )


def _prototype(cases: Sequence[Result]) -> str:
    """The fused pass beside the C++ prototype, and the factors that this rests on."""
    measured: dict[Size, dict[str, Any]] = {}
    loads: dict[Size, float] = {}
    for case in cases:
        if case["group"].startswith("prototype") and "timings" in case:
            size = (case["gaussians"], case["width"], case["height"])
            measured.setdefault(size, {})[case["group"]] = case["timings"]
            loads[size] = max(loads.get(size, 0.0), case["load"])
    if not measured:
        return ""
    text = (
        "## The fused pass beside a C++ prototype with SIMD written by hand\n\n"
        "The prototype was measured on another machine with 2 AVX2 cores. *Ratio* divides the "
        "fused pass here by its "
        "time there, nothing scaled. *Scaled ratio* first multiplies its time by a factor for the "
        "machine: the time of "
        "a 32-64-64-1 MLP here over its time there, measured in turns with the fused pass, once "
        "with torch using all "
        "instructions of this machine and once with torch kept to AVX2. The other workloads are "
        "shown to tell how far "
        "such factors scatter; `benchmarks/prototype.py` says why they are not used. A ratio "
        "taken under load decides "
        "nothing."
    )
    return "\n\n".join([text, _ratios(measured, loads), _factors(measured)])


def _ratios(measured: dict[Size, dict[str, Any]], loads: dict[Size, float]) -> str:
    rows = []
    for size, groups in measured.items():
        e = estimate(size, groups)
        low, high = e.ratios
        scaled = f"{low:.2f}" if len(groups) == 1 else f"{low:.2f} to {high:.2f}"
        verdict = e.verdict if loads[size] < LOADED else "undecided"
        shape = f"{size[0]:,}, {size[1]}×{size[2]}"
        times = [f"{e.measured_ms:.0f}", f"{CPP_MS[size]:.0f}", f"{NUMBA_MS[size]:.0f}"]
        rows.append(
            [
                shape,
                *times,
                f"{e.plain_ratio:.2f}",
                scaled,
                f"{e.target}",
                verdict,
                f"{loads[size]:.2f}",
            ]
        )
    return table(
        [
            "case",
            "here, ms",
            "C++ there, ms",
            "its Numba there, ms",
            "ratio",
            "scaled ratio",
            "at most",
            "",
            "load",
        ],
        rows,
    )


def _factors(measured: dict[Size, dict[str, Any]]) -> str:
    rows = []
    for (gaussians, width, height), groups in measured.items():
        for group, timings in groups.items():
            instructions = "all" if group == "prototype" else "AVX2"
            for workload in (MLP, SSIM_CONV, SSIM_SHIFTED, ADAM):
                low, high = known_ms(workload, width)
                there = f"{low:.0f}" if low == high else f"{low:.0f} to {high:.0f}"
                here = timings[workload]["median_ms"]
                rows.append(
                    [f"{gaussians:,}, "
                     f"{width}×{height}", workload, instructions, milliseconds(timings[workload]),
                     there,
                     f"{factor(workload, width, here):.2f}"]
                )  # fmt: skip
    return table(["case", "workload", "instructions", "here, ms", "there, ms", "factor"], rows)


def _group(name: str, cases: Sequence[Result]) -> str:
    """One table: a row per case and a column per stage, or the other way round where the stages
    have long names."""
    if not cases or name.startswith("prototype"):
        return ""
    group = GROUPS[name]
    found = [
        stage for case in cases for stage in case.get("timings", {}) if stage not in CALIBRATIONS
    ]
    stages = list(dict.fromkeys(found))
    if not stages:
        body = "Not measured."
    elif name == "gsplat":
        body = _stages_as_rows(cases, stages)
    else:
        body = table(
            [*_size_header(cases), *stages, "peak, MB", "load"],
            [_row(case, stages) for case in cases],
        )
    return f"## {group.title}\n\n{body}" + _remarks(cases)


def _size_header(cases: Sequence[Result]) -> list[str]:
    return [
        title
        for key, title in (("gaussians", "Gaussians"), ("width", "image"))
        if cases[0][key] is not None
    ]


def _size(case: Result) -> list[str]:
    gaussians = [] if case["gaussians"] is None else [f"{case['gaussians']:,}"]
    return gaussians + ([] if case["width"] is None else [f"{case['width']}×{case['height']}"])


def _row(case: Result, stages: Sequence[str]) -> list[str]:
    if "timings" not in case:
        return [*_size(case), *["–"] * (len(stages) + 2)]
    times = [milliseconds(case["timings"][stage]) for stage in stages]
    return [*_size(case), *times, f"{case['peak_bytes'] / 1e6:,.0f}", f"{case['load']:.2f}"]


def _stages_as_rows(cases: Sequence[Result], stages: Sequence[str]) -> str:
    header = ["", *(", ".join(_size(case)) for case in cases)]
    rows = [
        [
            stage,
            *(
                milliseconds(case["timings"][stage]) if stage in case.get("timings", {}) else "–"
                for case in cases
            ),
        ]
        for stage in stages
    ]
    return table(header, rows)


def _remarks(cases: Sequence[Result]) -> str:
    """What a case noted, and why one could not be measured."""
    lines = []
    for case in cases:
        where = ", ".join(_size(case))
        lines += [f"- {where}: {fact}: {value}" for fact, value in case.get("notes", {}).items()]
        lines += [
            f"- {where}: {kind}: {case[kind]}" for kind in ("skipped", "failed") if kind in case
        ]
    return "\n\n" + "\n".join(lines) if lines else ""
