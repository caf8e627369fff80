"""Short schedules, random Gaussians, and the states that steps and checkpoints start from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from mrgs.data import load_scene
from mrgs.method.config import TrainConfig, make_config
from mrgs.method.optimizer import OptimizerConfig
from mrgs.scene import Gaussians
from mrgs.training.state import TrainingState, initial_state, learned_layers
from tests.helpers.gaussians import random_gaussians
from tests.helpers.threads import one_torch_thread

__all__ = ["one_torch_thread"]


def short_config(method: str = "mrgs", max_steps: int = 60, **changes: Any) -> TrainConfig:
    """Fast learning rates, and nothing but optimization: no densification, no reset within the
    run."""
    config = make_config(method, "fast", max_steps=max_steps, max_gaussians=200)
    rates = replace(
        OptimizerConfig(),
        means=2e-3,
        means_final=5e-4,
        log_scales=0.02,
        sh_dc=0.03,
        temperature_dc=0.03,
    )
    schedule = replace(
        config.densification, start=max_steps, stop=max_steps, every=1_000, reset_every=1_000
    )
    return replace(config, optimizer=rates, densification=schedule, **changes)


def tensors_of(state: TrainingState) -> dict[str, torch.Tensor]:
    """Copies of everything that a step may change, by name."""
    tensors = {
        f"gaussians.{name}": tensor for name, tensor in state.gaussian_optimizer.state().items()
    }
    tensors |= {f"field.{name}": tensor for name, tensor in state.model.field.state_dict().items()}
    for term, layers in learned_layers(state.terms).items():
        tensors |= {f"terms.{term}.{name}": value for name, value in layers.state_dict().items()}
    for place, moments in state.layer_optimizer.state_dict()["state"].items():
        tensors |= {f"layer_optimizer.{place}.{key}": value for key, value in moments.items()}
    tensors |= {f"strategy.{name}": tensor for name, tensor in state.strategy_state.items()}
    return {name: tensor.detach().clone() for name, tensor in tensors.items()}


@pytest.fixture(scope="session")
def make_short_config() -> Callable[..., TrainConfig]:
    return short_config


@pytest.fixture(scope="session")
def make_gaussians() -> Callable[..., Gaussians]:
    return random_gaussians


@pytest.fixture(scope="session")
def snapshot() -> Callable[[TrainingState], dict[str, torch.Tensor]]:
    return tensors_of


@pytest.fixture
def make_start(small_scene: Path) -> Callable[..., tuple]:
    """The small scene, and the state at step 0 of a configuration."""

    def make(config: TrainConfig) -> tuple:
        scene = load_scene(small_scene)
        return scene, initial_state(scene, config)

    return make
