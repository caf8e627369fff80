"""The training of a model of Gaussians: its loop, a step, the state, views and photos."""

from mrgs.method.config import METHODS, PRESETS, TrainConfig, from_yaml, make_config
from mrgs.training.memory import estimate_bytes
from mrgs.training.start import Hooks, TrainOptions, train
from mrgs.training.step import StepStatistics

__all__ = [
    "METHODS",
    "PRESETS",
    "Hooks",
    "StepStatistics",
    "TrainConfig",
    "TrainOptions",
    "estimate_bytes",
    "from_yaml",
    "make_config",
    "train",
]
