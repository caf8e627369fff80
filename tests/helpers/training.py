"""Short schedules, and everything that a step of a training may change."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from mrgs.method.config import TrainConfig, make_config
from mrgs.method.optimizer import OptimizerConfig
from mrgs.training.state import TrainingState, learned_layers

FITTED = 4
"""Steps of the fit before the training, which takes longer than the training itself where there are
few Gaussians."""


def short_config(method: str = "mrgs", max_steps: int = 60, **changes: Any) -> TrainConfig:
    """Fast learning rates, and nothing but optimization: no densification, no reset within the
    run; temperatures are fitted for a moment."""
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
    fitted = min(config.fitted_residuals, FITTED)
    made = replace(config, optimizer=rates, densification=schedule, fitted_residuals=fitted)
    return replace(made, **changes)


def tensors_of(state: TrainingState) -> dict[str, torch.Tensor]:
    """Copies of everything that a step may change, by name."""
    tensors = {
        f"gaussians.{name}": tensor for name, tensor in state.gaussian_optimizer.state().items()
    }
    tensors |= {f"field.{name}": tensor for name, tensor in state.model.field.state_dict().items()}
    for term, layers in learned_layers(state.terms).items():
        tensors |= {f"terms.{term}.{name}": value for name, value in layers.state_dict().items()}
    layers = dict(enumerate(state.layer_optimizer.parameters()))
    moments = state.layer_optimizer.moments(layers)
    tensors |= {f"layer_optimizer.{name}": value for name, value in moments.items()}
    tensors |= {f"strategy.{name}": tensor for name, tensor in state.strategy_state.items()}
    return {name: tensor.detach().clone() for name, tensor in tensors.items()}
