"""Outcomes without runs, and options of runs that take a second."""

from __future__ import annotations

from typing import Any

from mrgs_compare.plan import Options
from mrgs_compare.table import Outcome, outcome

TINY: dict[str, Any] = {"preset": "fast", "max_steps": 3, "max_gaussians": 60}


def metrics_document(psnr: float = 30.0, **changes: Any) -> dict[str, Any]:
    """The content of a ``metrics.json``."""
    document: dict[str, Any] = {
        "steps": 3,
        "gaussians": 12_340,
        "train_seconds": 90.0,
        "mean": {
            "thermal": {"psnr": psnr, "psnr_matched": psnr + 1, "ssim": 0.95, "mae_c": 0.5},
            "rgb": {"psnr": psnr - 8, "psnr_matched": psnr - 7, "ssim": 0.8, "lpips": None},
        },
        "reasons": {"mean.rgb.lpips": "no weights"},
        "views": [],
    }
    return document | changes


def tiny_options(**changes: Any) -> Options:
    """Three steps of ``3dgs-rgbt`` and ``mrgs``, changed as given."""
    return Options(**(TINY | {"methods": ("3dgs-rgbt", "mrgs")} | changes))


def outcome_of(
    scene: str, method: str, seed: int | None = 0, psnr: float = 30.0, **changes: Any
) -> Outcome:
    """The outcome of a run; ``changes`` are those of its ``metrics.json``."""
    return outcome(scene, method, seed, metrics_document(psnr, **changes))
