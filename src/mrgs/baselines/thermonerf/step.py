"""One training step: a batch of rays from the photos, the losses, the moved parameters."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.baselines.thermonerf.config import ThermoNerfConfig
from mrgs.baselines.thermonerf.model import ThermoNerf, Traced
from mrgs.baselines.thermonerf.rays import Batch, PixelPool, SceneFrame, frame_of
from mrgs.method.adam import Adam, ParameterGroup
from mrgs.method.optimizer import are_finite
from mrgs.run_files.record import StepStatistics
from mrgs.scene import THERMAL, Scene
from mrgs.system.torch_modes import seeded


def squared_error(
    rendered: Float[Tensor, "r c"], target: Float[Tensor, "r c"], valid: Bool[Tensor, " r"] | None
) -> Float[Tensor, ""]:
    """Mean squared error over the valid rays; 0 if none is."""
    error = (rendered - target).square().mean(dim=1)
    if valid is None:
        return error.mean()
    return torch.where(valid, error, 0).sum() / valid.sum().clamp(min=1)


def interlevel_loss(
    edges: Float[Tensor, "r e"],
    weights: Float[Tensor, "r s"],
    proposal_edges: Float[Tensor, "r q"],
    proposal_weights: Float[Tensor, "r p"],
) -> Float[Tensor, ""]:
    """How far the field's weights stick out of what the proposals allow: Eq. 13 of mip-NeRF 360,
    mean over the rays. An interval's bound is the sum of the proposals that it touches (Eq. 12). No
    gradient reaches the field's weights."""
    edges, weights = edges.detach().contiguous(), weights.detach()
    total = proposal_weights.cumsum(dim=1)
    total = torch.cat([torch.zeros_like(total[:, :1]), total], dim=1)
    last = proposal_weights.shape[1]
    first_touched = (torch.searchsorted(proposal_edges, edges, right=True)[:, :-1] - 1).clamp(
        0, last
    )
    behind_touched = torch.searchsorted(proposal_edges, edges, right=False)[:, 1:].clamp(0, last)
    bound = total.gather(1, behind_touched) - total.gather(1, first_touched)
    excess = (weights - bound).clamp(min=0)
    return (excess.square() / (weights + 1e-7)).sum(dim=1).mean()


def distortion_loss(
    edges: Float[Tensor, "r e"], weights: Float[Tensor, "r s"]
) -> Float[Tensor, ""]:
    """Σ_ij w_i w_j |m_i − m_j| + ⅓ Σ_i w_i² (length of i): Eq. 15 of mip-NeRF 360, mean over the
    rays. The midpoints m ascend, so the double sum is one pass over sums of what lies before."""
    middles = 0.5 * (edges[:, 1:] + edges[:, :-1])
    lengths = edges[:, 1:] - edges[:, :-1]
    moments = weights * middles
    weight_before = weights.cumsum(dim=1) - weights
    moment_before = moments.cumsum(dim=1) - moments
    between = 2 * (weights * (middles * weight_before - moment_before)).sum(dim=1)
    within = (weights.square() * lengths).sum(dim=1) / 3
    return (between + within).mean()


WEIGHTS = {"interlevel": 1.0, "distortion": 0.002}
"""Weights of the terms; both squared errors have the weight 1."""

ADAM_EPSILON = 1e-15
"""Entries of the hash tables get rare and tiny gradients (Müller et al. 2022, Section 4)."""


@dataclass
class NerfState:
    """All that changes during training, and so all that a checkpoint contains; Adam is over all of
    the model's parameters, and the generator of every random choice after the start."""

    step: int
    model: ThermoNerf
    optimizer: Adam
    generator: torch.Generator
    skipped_in_a_row: int = 0


def initial_state(scene: Scene, config: ThermoNerfConfig) -> NerfState:
    """The state at step 0; every random choice follows from the seed, not torch's own generator."""
    return make_state(
        new_model(config.seed, frame_of(scene)), config, torch.Generator().manual_seed(config.seed)
    )


def new_model(seed: int, frame: SceneFrame) -> ThermoNerf:
    """An untrained model."""
    with seeded(seed):
        return ThermoNerf(frame)


def make_state(
    model: ThermoNerf, config: ThermoNerfConfig, generator: torch.Generator
) -> NerfState:
    """A state at step 0: a fresh optimizer around a model."""
    parameters = ParameterGroup(list(model.parameters()), config.learning_rate)
    optimizer = Adam([parameters], epsilon=ADAM_EPSILON)
    return NerfState(0, model, optimizer, generator)


def training_step(state: NerfState, pool: PixelPool, config: ThermoNerfConfig) -> StepStatistics:
    """Draw rays, compare what they see with the photos, move the parameters in place. The terms are
    the squared error of each modality by its name, "interlevel" and "distortion", unweighted."""
    state.step += 1
    batch = pool.draw(config.rays_per_batch, state.generator)
    rows = {modality: target.rows for modality, target in batch.targets.items()}
    traced = state.model.trace(batch.rays, rows, state.generator)
    terms = loss_terms(traced, batch)
    loss = torch.stack([WEIGHTS.get(name, 1.0) * term for name, term in terms.items()]).sum()
    loss.backward()

    gradients = [each.grad for each in state.model.parameters() if each.grad is not None]
    skipped = not bool(are_finite(loss, gradients))
    if skipped:
        state.skipped_in_a_row += 1
    else:
        state.skipped_in_a_row = 0
        for group in state.optimizer.groups:
            group.rate = config.learning_rate_at(state.step)
        state.optimizer.step()
    state.optimizer.zero_grad()
    error = _thermal_error(traced, batch)
    return StepStatistics(state.step, loss, terms, error, None, skipped)


def loss_terms(traced: Traced, batch: Batch) -> dict[str, Tensor]:
    """The squared error of each modality of the batch, and the two terms on the weights."""
    terms = {
        modality.name: squared_error(traced.values[modality], target.values, target.valid)
        for modality, target in batch.targets.items()
    }
    terms["interlevel"] = interlevel_loss(*traced.samples)
    terms["distortion"] = distortion_loss(traced.samples.edges, traced.samples.weights)
    return terms


def _thermal_error(traced: Traced, batch: Batch) -> float | None:
    """Mean absolute error of the normalised temperature over the valid rays."""
    if THERMAL not in batch.targets:
        return None
    target = batch.targets[THERMAL]
    error = (traced.values[THERMAL].detach() - target.values).abs()
    counted = error if target.valid is None else error[target.valid]
    return counted.mean().item() if counted.numel() > 0 else None
