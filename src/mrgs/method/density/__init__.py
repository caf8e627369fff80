"""Density control: strategies that add, remove and move Gaussians during training."""

from typing import TypeAlias

from mrgs.method.density.adaptive import AdaptiveDensityControl
from mrgs.method.density.strategy import DensityStep, DensityUpdate, Strategy, StrategyState

ConfiguredStrategy: TypeAlias = AdaptiveDensityControl
"""The strategies that ``densification`` in a config.yaml can name: a union, by the field
``name``."""

__all__ = [
    "AdaptiveDensityControl",
    "ConfiguredStrategy",
    "DensityStep",
    "DensityUpdate",
    "Strategy",
    "StrategyState",
]
