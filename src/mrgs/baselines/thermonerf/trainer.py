"""The training loop."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import torch

from mrgs.baselines.thermonerf.config import METHOD, ThermoNerfConfig, from_yaml
from mrgs.baselines.thermonerf.model import ALL_ROWS
from mrgs.baselines.thermonerf.pixels import MODALITIES, PixelPool
from mrgs.baselines.thermonerf.run import load_state, require_cpu, save, tensors_of
from mrgs.baselines.thermonerf.step import NerfState, initial_state, training_step
from mrgs.errors import RunError
from mrgs.run_files.facts import CheckpointFacts
from mrgs.run_files.folder import RunFolder
from mrgs.run_files.record import RunRecord, asks_to_stop
from mrgs.scene import Scene
from mrgs.system.operation import checking
from mrgs.system.torch_modes import own_modes
from mrgs.system.turns import ctrl_c_waits
from mrgs.training.start import (
    DEFAULT_OPTIONS,
    NO_HOOKS,
    Hooks,
    TrainOptions,
    begun_run,
)

CHECKED_RAYS = 32
"""Number of rays on which the kernels are compared with their plain definitions."""


def train_thermonerf(
    scene: Scene | str | Path,
    output: str | Path,
    config: ThermoNerfConfig,
    options: TrainOptions = DEFAULT_OPTIONS,
    hooks: Hooks = NO_HOOKS,
    *,
    stop_at: int | None = None,
) -> RunFolder:
    """Train a ThermoNeRF of a scene into a run folder; the arguments are those of ``mrgs.train``.

    Raises:
        SceneError: the scene cannot be used.
        RunError: the output folder cannot be used, or the scene has changed since the run began.
        DeviceError: the GPU was asked for.
        TrainingError: three steps in a row gave values that are not finite, or the model has such a
            value; the last good checkpoint is kept.
    """
    require_cpu(options.device)
    folder = RunFolder(output)
    if options.resume and folder.method != METHOD:
        raise RunError(f"{folder.path} is a run of {folder.method}, not of {METHOD}")
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
    _check_kernels(state, pool)
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
            if hooks.on_step is not None and asks_to_stop(hooks.on_step(statistics)):
                last = record.step
        except BaseException:
            if is_whole:
                record.save()
            raise
        record.save_if_due(last)


def _check_kernels(state: NerfState, pool: PixelPool) -> None:
    """Compare the kernels in use with their plain definitions; the state stays the same."""
    generator = torch.Generator().manual_seed(0)
    batch = pool.draw(CHECKED_RAYS, generator)
    with checking(), own_modes():
        state.model.trace(batch.rays, dict.fromkeys(MODALITIES, ALL_ROWS), generator)
