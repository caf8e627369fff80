"""Runs one part of the GPU benchmark: ``python -m benchmarks.gpu_part REQUEST``, started by
``gpu``.

A process of its own: a kernel that goes wrong leaves no GPU to the rest of its process. Results are
written after each one, so that what was measured before is kept.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from benchmarks.gpu_plan import PLANS
from benchmarks.gpu_stages import PARTS, Order
from mrgs.system.gpu import choose_device
from mrgs.system.torch_modes import own_modes


def main() -> None:
    """Write the part's rows into the request's file."""
    request = json.loads(sys.argv[1])
    plan, device = PLANS[request["plan"]], choose_device(request["device"])
    order = Order(plan, device, request["until"], request["method"])
    path, rows = Path(request["file"]), []
    with own_modes(device):  # as in a training
        for row in PARTS[request["part"]](order):
            rows.append(row)
            unfinished = path.with_suffix(".unfinished")
            unfinished.write_text(json.dumps(rows))
            os.replace(unfinished, path)


if __name__ == "__main__":
    main()
