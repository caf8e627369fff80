"""Runs of ThermoNeRF: trained, kept in checkpoints, and opened to be rendered from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.errors import DeviceError, RunError
from mrgs.method.adam import Adam, ParameterGroup
from mrgs.method.optimizer import are_finite
from mrgs.run_files import checkpoint
from mrgs.run_files.facts import CheckpointFacts
from mrgs.run_files.folder import RunFolder
from mrgs.run_files.record import RunRecord, StepStatistics, asks_to_stop
from mrgs.runs.trained_run import TrainedRun
from mrgs.scene import THERMAL, Camera, Modality, Rendering, Scene
from mrgs.system.gpu import DeviceName
from mrgs.system.operation import checking
from mrgs.system.threads import ctrl_c_waits
from mrgs.system.torch_modes import own_modes, seeded
from mrgs.training.start import DEFAULT_OPTIONS, NO_HOOKS, Hooks, TrainOptions, begun_run
from mrgs_thermonerf.config import NAME, ThermoNerfConfig, from_yaml
from mrgs_thermonerf.model import ALL_ROWS, ThermoNerf, Traced
from mrgs_thermonerf.rays import MODALITIES, Batch, PixelPool, SceneFrame, frame_of

CHECKED_RAYS = 32
"""Number of rays on which the kernels are compared with their plain definitions."""


def tensors_of(state: NerfState) -> dict[str, Tensor]:
    """All tensors of a training, by name."""
    frame = state.model.frame
    tensors = {f"model.{name}": tensor for name, tensor in state.model.state_dict().items()}
    moments = state.optimizer.moments(dict(state.model.named_parameters()))
    tensors |= {f"adam.{name}": tensor for name, tensor in moments.items()}
    tensors["generator"] = state.generator.get_state()
    tensors["frame.centre"] = frame.centre
    tensors["frame.sizes"] = torch.tensor(
        [frame.radius, frame.near, frame.middle, frame.far], dtype=torch.float64
    )
    return tensors


def save(path: Path, state: NerfState, facts: CheckpointFacts) -> None:
    """Write everything needed to resume exactly; see ``write_file``."""
    header = {**facts.to_json(), "skipped_in_a_row": state.skipped_in_a_row}
    checkpoint.write_file(path, tensors_of(state), header)


def load_model(path: Path, config: ThermoNerfConfig) -> tuple[ThermoNerf, CheckpointFacts]:
    """The model of a checkpoint, to render with; see ``read``."""
    tensors, facts, _ = checkpoint.read(path)
    with checkpoint.fitting(path):
        return _model(tensors, config), facts


def load_state(path: Path, config: ThermoNerfConfig) -> NerfState:
    """Everything in a checkpoint, to train on; see ``read``."""
    tensors, facts, header = checkpoint.read(path)
    with checkpoint.fitting(path):
        generator = torch.Generator()
        generator.set_state(tensors["generator"])
        state = make_state(_model(tensors, config), config, generator)
        parameters = dict(state.model.named_parameters())
        state.optimizer.load_moments(parameters, checkpoint.below(tensors, "adam."))
        state.step, state.skipped_in_a_row = facts.step, checkpoint.skipped_in_a_row_of(header)
        checkpoint.require_like(tensors, tensors_of(state))
    return state


def _model(tensors: Mapping[str, Tensor], config: ThermoNerfConfig) -> ThermoNerf:
    """The model of a checkpoint. KeyError or ValueError if its tensors do not fit the config."""
    frame = checkpoint.below(tensors, "frame.")
    numbers = {"centre": (3,), "sizes": (4,)}
    checkpoint.require_like(
        frame, {name: torch.empty(shape, dtype=torch.float64) for name, shape in numbers.items()}
    )
    radius, near, middle, far = frame["sizes"].tolist()
    if not (0 < radius < math.inf and 0 <= near < far < math.inf and 0 < middle < math.inf):
        raise ValueError("the frame has no size")
    model = new_model(config.seed, SceneFrame(frame["centre"], radius, near, middle, far))
    layers = checkpoint.below(tensors, "model.")
    checkpoint.require_like(layers, model.state_dict())
    model.load_state_dict(layers)
    return model


def train_thermonerf(
    scene: Scene | str | Path,
    output: str | Path,
    config: ThermoNerfConfig,
    options: TrainOptions = DEFAULT_OPTIONS,
    hooks: Hooks = NO_HOOKS,
    *,
    stop_at: int | None = None,
) -> RunFolder:
    """Train a ThermoNeRF of a scene into a run folder; see ``mrgs.train``. DeviceError if the GPU
    was asked for; other errors as for ``mrgs.train``."""
    require_cpu(options.device)
    folder = RunFolder(output)
    if options.resume and folder.method != NAME:
        raise RunError(f"{folder.path} is a run of {folder.method}, not of {NAME}")
    if isinstance(scene, Scene) and not options.resume:
        config = replace(config, resolution=scene.resolution)
    begun = begun_run(
        folder, scene, config, options, hooks, read=from_yaml, load=load_state, start=initial_state
    )
    with begun as (loaded, config, state, facts):
        last = config.max_steps if stop_at is None else min(stop_at, config.max_steps)
        log = folder.tensorboard_log(facts.step) if options.tensorboard else nullcontext()
        with log:
            _train(folder, facts, loaded, config, state, hooks, last)
    return folder


def _train(
    folder: RunFolder,
    facts: CheckpointFacts,
    scene: Scene,
    config: ThermoNerfConfig,
    state: NerfState,
    hooks: Hooks,
    last: int,
) -> None:
    """Train until the step ``last``, or until ``on_step`` returns True; whatever ends the training,
    the last whole step is checkpointed."""
    pool = PixelPool(scene, state.model.frame)
    generator = torch.Generator().manual_seed(0)
    with checking(), own_modes():  # the state stays the same
        rays = pool.draw(CHECKED_RAYS, generator).rays
        state.model.trace(rays, dict.fromkeys(MODALITIES, ALL_ROWS), generator)
    record = RunRecord(
        folder,
        facts,
        config,
        tensors=lambda: tensors_of(state),
        write=lambda path, facts: save(path, state, facts),
        skipped_in_a_row=state.skipped_in_a_row,
    )
    while record.step < last:
        is_whole = False
        try:
            with ctrl_c_waits(), own_modes():
                statistics = training_step(state, pool, config)
                record.add(statistics)
                is_whole = True
            if hooks.progress is not None:
                hooks.progress(record.step, config.max_steps)
            if hooks.on_step is not None and asks_to_stop(hooks.on_step(statistics)):
                last = record.step
        except BaseException:
            if is_whole:
                record.save()
            raise
        record.save_if_due(last)


@dataclass(frozen=True, eq=False)
class ThermoNerfRun(TrainedRun):
    """A run that can be rendered and scored, but has no Gaussians."""

    config: ThermoNerfConfig
    model: ThermoNerf

    def render_cameras(self, cameras: Mapping[Modality, Camera]) -> Rendering:  # noqa: D102
        return self.model.render(cameras)

    @property
    def modalities(self) -> tuple[Modality, ...]:  # noqa: D102
        return MODALITIES

    @property
    def gaussian_count(self) -> None:  # noqa: D102
        return None


def open_thermonerf(
    path: str | Path, scene: str | Path | None = None, device: DeviceName = "auto"
) -> ThermoNerfRun:
    """Open the newest checkpoint of a ThermoNeRF run, which renders on the CPU; errors as for
    ``open_run``, and DeviceError if the GPU was asked for."""
    require_cpu(device)
    folder = RunFolder(path)
    config = folder.read_whole_config(from_yaml)
    model, facts = folder.load_newest(lambda file: load_model(file, config))
    # A camera in the middle of the scene, of a few rays: enough to compare kernels.
    K = torch.tensor([[4.0, 0, 4.0], [0, 4.0, 2.0], [0, 0, 1]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = -model.frame.centre
    with checking(gradients=False):
        model.render(dict.fromkeys(MODALITIES, Camera(K, viewmat, 8, 4)))
    return ThermoNerfRun(folder, config, facts.moved_to(scene), model)


def require_cpu(device: DeviceName) -> None:
    """Raise ``DeviceError`` if the GPU was asked for, for which there are no kernels."""
    if device == "cuda":
        raise DeviceError("thermonerf works on the CPU alone")


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
