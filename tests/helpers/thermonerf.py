"""ThermoNeRF, small enough to train in a test."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from mrgs.baselines.thermonerf import ThermoNerfConfig
from mrgs.baselines.thermonerf.networks import HashGridConfig, NerfFieldConfig
from mrgs.baselines.thermonerf.sampling import SamplingConfig


def small_config(max_steps: int = 20, **changes: Any) -> ThermoNerfConfig:
    """Small grids and few rays."""
    config = ThermoNerfConfig(
        max_steps=max_steps,
        rays_per_batch=256,
        field=NerfFieldConfig(grid=HashGridConfig(4, 4, 64, 12), hidden_width=16),
        proposal=HashGridConfig(3, 4, 32, 10),
        sampling=SamplingConfig(proposal=24, field=12),
    )
    return replace(config, **changes)
