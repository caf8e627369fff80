"""Outcomes without runs, and options of runs that take a second."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from mrgs.comparison.methods import Options
from mrgs.comparison.results import Outcome, outcome

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
    return Options(**(TINY | {"methods": ("3dgs-rgbt", "mrgs")} | changes))


@pytest.fixture
def make_options() -> Callable[..., Options]:
    """Three steps of ``3dgs-rgbt`` and ``mrgs`` unless told otherwise."""
    return tiny_options


@pytest.fixture
def make_document() -> Callable[..., dict[str, Any]]:
    return metrics_document


@pytest.fixture
def make_outcome() -> Callable[..., Outcome]:
    """``make_outcome(scene, method, seed, psnr, **changes of metrics.json)``."""

    def make(
        scene: str, method: str, seed: int | None = 0, psnr: float = 30.0, **changes: Any
    ) -> Outcome:
        return outcome(scene, method, seed, metrics_document(psnr, **changes))

    return make
