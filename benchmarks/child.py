"""Measures one case: ``python -m benchmarks.child REQUEST``, started by ``processes``."""

from __future__ import annotations

import dataclasses
import importlib
import os
from collections.abc import Callable
from typing import Any

import torch

from benchmarks import memory
from benchmarks.plan import GROUPS, Case, Effort
from benchmarks.timing import SkippedError, Stages, measure
from mrgs.kernels import TABLE
from mrgs.system.child import read_request, send, when_asked_to_stop


def prepare(case: Case) -> Stages:
    """The stages of a case."""
    module, function = GROUPS[case.group].prepare.split(":")
    make: Callable[[Case], Stages] = getattr(importlib.import_module(module), function)
    return make(case)


def result_of(
    case: Case, effort: Effort, base_bytes: int, prepare: Callable[[Case], Stages] = prepare
) -> dict[str, Any]:
    """Times, peak memory above ``base_bytes`` and notes of a case; or the reason why there are
    none."""
    from benchmarks.calibration import Calibration

    calibration = Calibration()
    try:
        stages = prepare(case)
        summaries = measure([*calibration.timings, *stages.timings], effort)
    except SkippedError as reason:
        return {"skipped": str(reason)}
    except MemoryError:
        return {"skipped": "out of memory"}
    except RuntimeError as error:
        if "allocate memory" not in str(error):
            raise
        return {"skipped": "out of memory"}
    peak = memory.peak_bytes() - calibration.nbytes - base_bytes
    times = {name: dataclasses.asdict(summary) for name, summary in summaries.items()}
    return {"timings": times, "peak_bytes": max(peak, 0), "notes": stages.notes}


def import_kernels() -> None:
    """Numba and the kernels' modules, which operations import at their first call: memory that is
    no case's either."""
    for kernel in TABLE:
        if kernel.device == "cpu":
            importlib.import_module(kernel.function.rpartition(".")[0])


def main() -> None:
    """Measure the cases of the request one after the other; the last one's result is sent."""
    when_asked_to_stop(lambda: os._exit(1))
    request = read_request()
    torch.set_num_threads(request["threads"])
    import_kernels()
    memory.reset_peak()
    base_bytes = memory.resident_bytes()
    result: dict[str, Any] = {}
    for values in request["cases"]:
        case = Case(**values)
        limit = GROUPS[case.group].memory_limit
        if limit is not None:
            memory.limit_address_space(limit)
        result = result_of(case, Effort(**request["effort"]), base_bytes)
    send(end="done", result=result)


if __name__ == "__main__":
    main()
