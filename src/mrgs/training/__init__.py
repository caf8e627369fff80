"""From a scene folder to a trained run: the loop, its state, views and photos, checkpoints, the run
folder."""

from mrgs.method.config import METHODS, PRESETS, TrainConfig, from_yaml, make_config
from mrgs.training.memory import estimate_bytes
from mrgs.training.opening import train
from mrgs.training.step import StepStatistics

__all__ = [
    "METHODS",
    "PRESETS",
    "StepStatistics",
    "TrainConfig",
    "estimate_bytes",
    "from_yaml",
    "make_config",
    "train",
]
