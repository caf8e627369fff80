"""The configurations of the runs that are damaged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from mrgs.method.camera_model.image_model import ImageModelConfig
from mrgs.training import checkpoint
from mrgs_thermonerf import run as nerf_checkpoint
from tests.helpers.thermonerf import small_config
from tests.helpers.training import short_config


def _eventful() -> Any:
    config = short_config(
        "mrgs",
        max_steps=10,
        checkpoint_every=5,
        neighbours_every=3,
        image_model=ImageModelConfig(point_spread=True),
        angular_dilation=True,
    )
    schedule = replace(config.densification, start=1, stop=9, every=4, gradient_threshold=1e-6)
    return replace(config, densification=schedule)


GAUSSIANS = _eventful()
"""Densifies at steps 4 and 8."""

NERF = small_config(10, checkpoint_every=5)


def load_gaussians(path: Path) -> Any:
    """The state in a checkpoint of the run of Gaussians."""
    return checkpoint.load_state(path, GAUSSIANS)


def load_nerf(path: Path) -> Any:
    """The state in a checkpoint of the run of a radiance field."""
    return nerf_checkpoint.load_state(path, NERF)
