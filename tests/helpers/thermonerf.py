"""ThermoNeRF, quick to train in a test."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from mrgs_thermonerf import ThermoNerfConfig


def small_config(max_steps: int = 20, **changes: Any) -> ThermoNerfConfig:
    """Few steps of few rays."""
    return replace(ThermoNerfConfig(max_steps=max_steps, rays_per_batch=64), **changes)
