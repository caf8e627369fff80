"""Density control: strategies that add, remove and move Gaussians during training."""

from typing import TypeAlias

from mrgs.method.density.adaptive import AdaptiveDensityControl
from mrgs.method.density.strategy import DensityStep, DensityUpdate, Strategy, StrategyState

ConfiguredStrategy: TypeAlias = AdaptiveDensityControl
"""Strategies that ``densification`` in a config.yaml can name: a union, tagged by ``name``."""

__all__ = [
    "AdaptiveDensityControl",
    "ConfiguredStrategy",
    "DensityStep",
    "DensityUpdate",
    "Strategy",
    "StrategyState",
]
