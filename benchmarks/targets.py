"""What a training step may cost on 2 cores, and whether a run's figures keep to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

MS_PER_S = 1e3


@dataclass(frozen=True)
class Target:
    """A limit on one figure of one case.

    Attributes:
        title: as the report prints it.
        group: of the case.
        gaussians: of the case; None where the group does not depend on N.
        width: of the case; None where the group does not depend on the image.
        timing: the stage; None for peak memory.
        limit: largest value: ms, or GB for peak memory.
    """

    title: str
    group: str
    gaussians: int | None
    width: int | None
    timing: str | None
    limit: float

    def value(self, cases: Sequence[dict[str, Any]]) -> float | None:
        """The measured figure, in the limit's unit; None if the run does not hold it."""
        for case in cases:
            if (case["group"], case["gaussians"], case["width"]) == (
                self.group,
                self.gaussians,
                self.width,
            ):
                if self.timing is None:
                    return case["peak_bytes"] / 1e9 if "peak_bytes" in case else None
                summary = case.get("timings", {}).get(self.timing)
                return None if summary is None else float(summary["median_ms"])
        return None


TARGETS = (
    Target("L1 + D-SSIM of 4 channels, "
           "640×480", "losses", None, 640, "L1 + D-SSIM, 4 channels", 20.0),
    Target("MrGS step, 50,000 Gaussians, 320×240", "mrgs", 50_000, 320, "step", MS_PER_S / 8),
    Target("MrGS step, 50,000 Gaussians, 640×480", "mrgs", 50_000, 640, "step", MS_PER_S / 5),
    Target(
        "densification event, 50,000 Gaussians",
        "densification", 50_000, None, "rows moved and neighbours searched", 400.0,
    ),
    Target("rendering only, 50,000 Gaussians, "
           "640×480", "render", 50_000, 640, "render", MS_PER_S / 30),
    Target("peak memory of MrGS, 200,000 Gaussians, 640×480", "mrgs", 200_000, 640, None, 2.0),
)  # fmt: skip
