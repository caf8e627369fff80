"""The GPU benchmark's tables."""

from __future__ import annotations

from benchmarks.gpu_plan import PARTS
from benchmarks.gpu_report import spread, to_markdown
from tests.benchmarks.tables import rows as rows_of


def test_a_median_comes_with_its_quartiles():
    assert spread({"median_ms": 0.5, "q1_ms": 0.4, "q3_ms": 0.625}) == "0.500 (0.400–0.625)"
    assert spread({"median_ms": 1234.5, "q1_ms": 1000, "q3_ms": 2000}) == "1,234 (1,000–2,000)"


def sample(times: tuple[str, ...]) -> dict:
    return {name: {"median_ms": 2.0, "q1_ms": 1.5, "q3_ms": 3.0} for name in times}


def test_the_report_of_a_gpu():
    size = {"gaussians": 50_000, "width": 640, "height": 480}
    both = ("forward", "forward + backward")
    ways = {"mrgs": 2.0, "two passes": 3.0, "shared projection": 2.5}
    compared = {n: {"median_ms": ms, "q1_ms": ms, "q3_ms": ms} for n, ms in ways.items()}
    waits = {"mrgs/rasterizer/gpu.py:7": 1}
    device = {
        "device": "A GPU", "capability": "9.0", "multiprocessors": 132, "memory_bytes": 2**37,
        "cuda": "13.0",
        "triton": "3.6.0", "torch": "2.11", "python": "3.12", "copy_bytes_per_s": 4e12,
        "float32_operations_per_s": 5e13, "launch_s": 4e-6, "driver": "580.1", "date": "2026-11-26",
    }  # fmt: skip
    timed = {
        "times": sample((*both, "recorded")),
        "peak_bytes": 10**8,
        "least_bytes": 4 * 10**8,
        "host_waits": waits,
    }
    step = {
        "times": sample(("step",)),
        "peak_bytes": 10**9,
        "host_waits": waits,
        "steps_per_s": 161.4,
        "rerecord_ms": 123.4,
    }
    trained = {
        "method": "mrgs",
        "steps": 9_000,
        "of_steps": 30_000,
        "seconds": 90,
        "steps_per_s": 100,
        "seconds_growing": 45.4,
        "warnings": ["steps take longer"],
        "gaussians": 47_000,
    }
    rows = {
        "device": [device],
        "correctness": [
            {"of": "image", "error": e, "limit": 1e-4, "ok": e < 1e-4} for e in (1e-6, 2e-6)
        ],
        "gsplat": [
            {"gsplat": "1.5.3"},
            {
                **size,
                "times": {
                    "forward": compared,
                    "forward + backward": compared
                    | {"recorded": compared["mrgs"] | {"median_ms": 0.5}},
                },
                "mean_difference": {"two passes": 1e-6},
            },
        ],
        "rasterizer": [{**size, **timed}, {**size, "skipped": "out of memory"}],
        "step": [{"method": "mrgs", **size, **step}],
        "training": [
            {**trained, "peak_bytes": 10**9},
            {"method": "mrgs", "metrics": {"rgb psnr": 31.25}},
        ],
    }
    text = to_markdown(
        {
            "plan": "full",
            "seconds": 400,
            "parts": {name: {"rows": part} for name, part in rows.items()},
        }
    )
    for fact in (
        "A GPU", "9.0", "132 multiprocessors", "128 GiB", "driver 580.1", "CUDA 13.0",
        "Triton 3.6.0", "4,000 GB/s", "2026-11-26", "400 s", "out of memory",
        "mrgs/rasterizer/gpu.py:7", "steps take longer",
    ):  # fmt: skip
        assert fact in text
    found = rows_of(text)
    theirs = ["3.00 (3.00–3.00)", "2.50 (2.50–2.50)", "1.50", "1.25"]
    for cells in (
        ["image", "2", "2.0e-06", "1e-04", ""],
        ["–", *theirs, "–"],
        ["0.500 (2.000–2.000)", *theirs, "6.00"],
        ["2.00 (1.50–3.00)", "2.00 (1.50–3.00)", "0.100", "100", "1"],
        ["161", "123", "1,000", "1"],
        ["mrgs", "9,000 of 30,000", "90", "45", "100", "47,000", "1,000"],
        ["rgb psnr", "31.25"],
    ):
        assert any(row[-len(cells) :] == cells for row in found), cells


def test_the_report_says_where_a_result_is_missing():
    size = {"gaussians": 50_000, "width": 640, "height": 480}
    failed = {**size, "failed": "ValueError: a | b"}
    rows = {
        "correctness": [
            {"of": "image", "skipped": "out of memory", "ok": True},
            {"of": "loss", **failed, "ok": False},
        ],
        "gsplat": [failed],
        "rasterizer": [failed],
        "step": [{"method": "mrgs", **failed}],
    }
    parts = {"device": {"skipped": "no time"}} | {
        name: {"rows": part} for name, part in rows.items()
    }
    text = to_markdown({"plan": "quick", "seconds": 1, "parts": parts})
    assert ["image", "1", "", "", "out of memory"] in rows_of(text)
    assert text.count(r"| **failed**: ValueError: a \| b |") == 4


def test_the_report_names_what_is_missing():
    parts = {name: {"skipped": "no time"} for name in ("device", *PARTS)}
    text = to_markdown({"plan": "quick", "seconds": 1, "parts": parts})
    assert text.count("Skipped: no time.") == len(PARTS)
    assert text.count("no time") == len(PARTS) + 1  # and the device
