"""How much work a pipeline puts into a model."""

from __future__ import annotations

from dataclasses import dataclass

from mrgs.method.config import DEFAULT_METHOD, TrainConfig
from mrgs.runs.registry import find_method


@dataclass(frozen=True)
class Quality:
    """A quality: steps, size of the model, and size of the photos.

    Attributes:
        name: its name.
        preset: of ``mrgs train``.
        max_steps: training steps.
        max_gaussians: cap on the Gaussians.
        resolution: photos that are wider than this many pixels are reduced to it.
    """

    name: str
    preset: str
    max_steps: int
    max_gaussians: int
    resolution: int

    def config(self) -> TrainConfig:
        """The configuration of the training."""
        config: TrainConfig = find_method(DEFAULT_METHOD).configure(
            self.preset,
            max_steps=self.max_steps,
            max_gaussians=self.max_gaussians,
            resolution=self.resolution,
        )
        return config


QUALITIES: dict[str, Quality] = {
    each.name: each
    for each in (
        Quality("fast", "fast", 1_500, 20_000, 640),
        Quality("default", "default", 4_000, 50_000, 1_024),
        Quality("best", "default", 8_000, 100_000, 1_600),
    )
}
