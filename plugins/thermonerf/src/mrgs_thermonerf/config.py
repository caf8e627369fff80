"""A ThermoNeRF run's whole configuration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mrgs.errors import ConfigError
from mrgs.system.strict_yaml import MOST_RATE, MOST_SEED, MOST_STEPS, read_yaml, require_within

NAME: Literal["thermonerf"] = "thermonerf"

MOST_RAYS = 10**6
"""Of a batch."""

PRESETS = {"fast": (1_500, 1_024), "default": (4_000, 1_024), "paper": (30_000, 4_096)}
"""Steps, and rays of each: as many steps as the other methods; for ``paper`` the usual batch."""


@dataclass(frozen=True)
class ThermoNerfConfig:
    """Everything that a run depends on besides the scene.

    Attributes:
        method: always ``thermonerf``.
        max_steps: training steps, one batch of rays each.
        rays_per_batch: rays of a step, drawn over all training views.
        resolution: images wider than this many pixels are reduced to it; None keeps them.
        learning_rate: of Adam, at the first step.
        learning_rate_final: at the last step; in between it decays exponentially.
    """

    method: Literal["thermonerf"] = NAME
    max_steps: int = 4_000
    rays_per_batch: int = 1_024
    resolution: int | None = None
    seed: int = 0
    learning_rate: float = 1e-2
    learning_rate_final: float = 5e-4
    checkpoint_every: int = 1_000

    def __post_init__(self) -> None:
        require_within(self, ("max_steps", "checkpoint_every"), 1, MOST_STEPS)
        require_within(self, ["rays_per_batch"], 1, MOST_RAYS)
        require_within(self, ["seed"], 0, MOST_SEED)
        require_within(self, ["learning_rate"], 0, MOST_RATE)
        if self.resolution is not None and self.resolution < 16:
            raise ConfigError(f"resolution must be at least 16 px, not {self.resolution}")
        if not 0 < self.learning_rate_final <= self.learning_rate:
            raise ConfigError(
                "learning_rate_final must be positive and not above learning_rate, "
                f"not {self.learning_rate_final} with {self.learning_rate}"
            )

    def learning_rate_at(self, step: int) -> float:
        """Adam's learning rate of this step, counted from 1."""
        share = step / self.max_steps
        return self.learning_rate * (self.learning_rate_final / self.learning_rate) ** share


def make_config(
    preset: str = "default",
    max_steps: int | None = None,
    resolution: int | None = None,
    seed: int = 0,
) -> ThermoNerfConfig:
    """The configuration of a preset; ``max_steps`` stretches or shrinks its schedule. ConfigError
    for an unknown preset, or a value that is not allowed."""
    if preset not in PRESETS:
        raise ConfigError(f"unknown preset {preset!r}; choose one of {', '.join(PRESETS)}")
    steps, rays = PRESETS[preset]
    steps = steps if max_steps is None else max_steps
    return ThermoNerfConfig(max_steps=steps, rays_per_batch=rays, resolution=resolution, seed=seed)


def from_yaml(text: str, source: str, base: ThermoNerfConfig | None = None) -> ThermoNerfConfig:
    """A configuration as ``write_yaml`` writes it, or a part of one; see ``read_yaml``."""
    return read_yaml(ThermoNerfConfig, text, source, base)
