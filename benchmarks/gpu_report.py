"""The GPU benchmark's results as markdown."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from benchmarks.gpu_plan import FORWARD, FORWARD_BACKWARD, PARTS, RECORDED, TRAINED_GAUSSIANS
from benchmarks.report import table

TARGET_STEPS_PER_S = 150
TARGET_TRAINING_S = 240
TARGET_BESIDE_GSPLAT = 1.3
"""What is aimed at on an H200: a step of mrgs at 50,000 Gaussians, the paper's training, and the
fused pass."""

Rows = Sequence[dict[str, Any]]
T = TypeVar("T")


def to_markdown(results: dict[str, Any]) -> str:
    """All parts, in their order; a part that did not run says why."""
    parts = results["parts"]
    text = ["# GPU benchmark", _head(parts["device"], results)]
    for name, title in PARTS.items():
        if name in parts:
            text.append(f"## {title[0].upper()}{title[1:]}")
            text += _part(name, parts[name], parts["device"].get("rows", []))
    return "\n\n".join(text) + "\n"


def _part(name: str, part: dict[str, Any], device: Rows) -> list[str]:
    rows, earlier = part.get("rows", []), part.get("device", [])
    lines = [_other_run(each) for each in earlier]
    lines += [_TABLES[name](rows, earlier or device)] if rows else []
    return lines + [
        f"{kind.capitalize()}: {part[kind]}." for kind in ("skipped", "failed") if kind in part
    ]


def _head(device: dict[str, Any], results: dict[str, Any]) -> str:
    if not device.get("rows"):
        return f"The device could not be examined: {device.get('failed', device.get('skipped'))}."
    d = device["rows"][0]
    names = [d["device"]]
    if "triton" in d:
        names += [
            f"compute capability {d['capability']}", f"{d['multiprocessors']} multiprocessors",
            f"{d['memory_bytes'] / 2**30:.0f} GiB", f"driver {d['driver']}", f"CUDA {d['cuda']}",
            f"Triton {d['triton']}",
        ]  # fmt: skip
    names += [f"torch {d['torch']}", f"Python {d['python']}"]
    trial = " A trial without a GPU: its times say nothing." if results["plan"] == "trial" else ""
    return (
        f"{', '.join(names)}. {results['plan'].capitalize()} run of {d['date']}, "
        f"{results['seconds']:.0f} s.{trial}\n\n"
        f"At most, as measured here: {d['copy_bytes_per_s'] / 1e9:,.0f} GB/s copying (bytes read "
        f"and written), "
        f"{d['float32_operations_per_s'] / 1e12:.1f} TFLOP/s in a float32 matrix product, one "
        f"small operation of torch "
        f"in {1e6 * d['launch_s']:.1f} µs. Times are medians in milliseconds; in brackets a "
        f"quarter and three quarters."
    )


def _other_run(device: dict[str, Any]) -> str:
    """Above a part that an earlier run has measured."""
    return (
        f"From another run, {device['date']}: {device['device']}, torch {device['torch']}, one "
        f"small operation of torch in {1e6 * device['launch_s']:.1f} µs."
    )


def _size(row: dict[str, Any]) -> str:
    return f"{row['gaussians']:,}, {row['width']}×{row['height']}"


def _named(row: dict[str, Any]) -> str:
    return f"{row['method']}, {_size(row)}" if "method" in row else _size(row)


def _missing(row: dict[str, Any]) -> str:
    """Why a row has no result, for a table's cell."""
    return (
        row["skipped"] if "skipped" in row else f"**failed**: {row['failed']}".replace("|", "\\|")
    )


def spread(times: dict[str, Any]) -> str:
    """A median with its quartiles."""
    digits = 3 if times["median_ms"] < 1 else 2 if times["median_ms"] < 100 else 0
    return (
        f"{times['median_ms']:,.{digits}f} "
        f"({times['q1_ms']:,.{digits}f}–{times['q3_ms']:,.{digits}f})"
    )


def _or_dash(value: T | None, text: Callable[[T], str]) -> str:
    return "–" if value is None else text(value)


def _memory(nbytes: int | None) -> str:
    return _or_dash(nbytes, lambda n: f"{n / 1e6:,.0f}")


def _whole(number: float | None) -> str:
    return _or_dash(number, lambda n: f"{n:.0f}")


def _ratio(theirs: dict[str, Any], ours: dict[str, Any] | None) -> str:
    return _or_dash(ours, lambda times: f"{theirs['median_ms'] / times['median_ms']:.2f}")


def _waits(rows: Rows) -> str:
    """Where the host waits, under the table."""
    lines = [
        f"- {_named(row)}: the host waits {count}× at {line}"
        for row in rows
        for line, count in row.get("host_waits", {}).items()
    ]
    return "\n\n" + "\n".join(lines) if lines else ""


def _correctness(rows: Rows, _: Rows) -> str:
    worst: dict[str, dict[str, Any]] = {}
    for row in (row for row in rows if "error" in row):
        if row["of"] not in worst or (worst[row["of"]]["ok"], -worst[row["of"]]["error"]) > (
            row["ok"],
            -row["error"],
        ):
            worst[row["of"]] = row
    counts = {name: sum(row["of"] == name for row in rows) for name in worst}
    lines = [
        [
            name,
            str(counts[name]),
            f"{row['error']:.1e}",
            f"{row['limit']:.0e}",
            "" if row["ok"] else "**wrong**",
        ]
        for name, row in worst.items()
    ]
    lines += [[row["of"], "1", "", "", _missing(row)] for row in rows if "error" not in row]
    return table(["", "cases", "largest error", "limit", ""], lines)


def _rasterizer(rows: Rows, device: Rows) -> str:
    lines = []
    for row in rows:
        if "times" not in row:
            lines.append([_size(row), _missing(row), *[""] * 5])
            continue
        floor = 1e3 * row["least_bytes"] / device[0]["copy_bytes_per_s"] if device else None
        waits = sum(row["host_waits"].values())
        lines.append(
            [_size(row), spread(row["times"][FORWARD]), spread(row["times"][FORWARD_BACKWARD]),
             _or_dash(row["times"].get(RECORDED), spread),
             _or_dash(floor, lambda ms: f"{ms:.3f}"), _memory(row["peak_bytes"]), str(waits)]
        )  # fmt: skip
    header = [
        "Gaussians, image",
        FORWARD,
        FORWARD_BACKWARD,
        "both, recorded",
        "least, by its bytes",
        "memory, MB",
        "host waits",
    ]
    return table(header, lines) + _waits(rows[:1])


def _gsplat(rows: Rows, _: Rows) -> str:
    versions = [row["gsplat"] for row in rows if "gsplat" in row]
    lines = []
    for row in (row for row in rows if "gaussians" in row):
        if "times" not in row:
            lines.append([_size(row), _missing(row), *[""] * 7])
            continue
        for direction, times in row["times"].items():
            ours, recorded = times["mrgs"], times.get(RECORDED)
            twice, once = times["two passes"], times["shared projection"]
            compared = [(twice, ours), (once, ours), (twice, recorded)]
            lines.append(
                [_size(row), direction, spread(ours), _or_dash(recorded, spread),
                 spread(twice), spread(once), *(_ratio(*pair) for pair in compared)]
            )  # fmt: skip
    header = [
        "Gaussians, image",
        "",
        "mrgs, fused",
        "recorded",
        "gsplat twice",
        "gsplat, projected once",
        "twice / fused",
        "once / fused",
        "twice / recorded",
    ]
    text = (
        f"gsplat {', '.join(versions)}, in turns in one process. A ratio above 1: mrgs takes "
        f"less time"
    )
    differences = [d for row in rows for d in row.get("mean_difference", {}).values()]
    agreement = (
        f"\n\nMean absolute difference of an image: at most {max(differences):.1e}."
        if differences
        else ""
    )
    return f"{text}; {TARGET_BESIDE_GSPLAT} is aimed at.\n\n" + table(header, lines) + agreement


def _step(rows: Rows, _: Rows) -> str:
    lines = [
        [row["method"], _size(row), _missing(row), *[""] * 4]
        if "times" not in row
        else [row["method"], _size(row), spread(row["times"]["step"]), f"{row['steps_per_s']:.0f}",
              _whole(row.get("rerecord_ms")), _memory(row["peak_bytes"]),
              str(sum(row["host_waits"].values()))]
        for row in rows
    ]  # fmt: skip
    aim = (
        f"Aimed at on an H200: {TARGET_STEPS_PER_S} steps per second at 50,000 Gaussians and "
        f"640×480.\n\n"
    )
    return (
        aim
        + table(
            [
                "method",
                "Gaussians, image",
                "step",
                "steps/s",
                "re-recording, ms",
                "memory, MB",
                "host waits",
            ],
            lines,
        )
        + _waits(rows)
    )


def _training(rows: Rows, _: Rows) -> str:
    trained = [row for row in rows if "steps" in row]
    scored = {row["method"]: row["metrics"] for row in rows if "metrics" in row}
    lines = [
        [row["method"], f"{row['steps']:,} of {row['of_steps']:,}", f"{row['seconds']:.0f}",
         _whole(row.get("seconds_growing")), f"{row['steps_per_s']:.3g}",
         f"{row['gaussians']:,}", _memory(row["peak_bytes"])]
        for row in trained
    ]  # fmt: skip
    header = [
        "method",
        "steps",
        "seconds",
        "while Gaussians are added",
        "steps/s",
        "Gaussians",
        "memory, MB",
    ]
    text = (
        f"Preset paper, at most {TRAINED_GAUSSIANS:,} Gaussians; the seconds are those of the "
        f"whole training, with loading the scene and compiling. They ran one after the other. "
        f"Fewer steps: the time was up. Aimed at on an H200: 30,000 steps in {TARGET_TRAINING_S} "
        f"s.\n\n"
    ) + table(header, lines)
    text += "".join(
        f"\n\n{row['method']}: {message}" for row in trained for message in row.get("warnings", [])
    )
    names = dict.fromkeys(name for metrics in scored.values() for name in metrics)
    figures = [[name, *(f"{metrics[name]:.4g}" for metrics in scored.values())] for name in names]
    return text + ("\n\n" + table(["", *scored], figures) if figures else "")


_TABLES: dict[str, Callable[[Rows, Rows], str]] = {
    "correctness": _correctness,
    "gsplat": _gsplat,
    "rasterizer": _rasterizer,
    "step": _step,
    "training": _training,
}
