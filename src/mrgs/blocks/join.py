"""One model from the blocks of a scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Int64
from torch import Tensor

from mrgs.blocks.plan import BlockPlan
from mrgs.blocks.refinement import Part, WholeModel
from mrgs.method.config import TrainConfig
from mrgs.method.losses.terms import configured_terms
from mrgs.run_files.checkpoint import below
from mrgs.run_files.facts import CheckpointFacts
from mrgs.run_files.folder import RunFolder
from mrgs.scene import Gaussians, Scene
from mrgs.scene.capture import model_modalities
from mrgs.system.torch_modes import seeded
from mrgs.training import checkpoint
from mrgs.training.state import TrainingState

DRIFT = "thermal_drift."
"""Prefix of the drift's tensors in an image model."""


class JoinedBlocks(NamedTuple):
    """The model of a scene, from its blocks, and the facts of the coarse run and of each block."""

    whole: WholeModel
    facts: tuple[CheckpointFacts, ...]


def join(
    coarse: RunFolder,
    blocks: Sequence[RunFolder],
    plan: BlockPlan,
    scene: Scene,
    config: TrainConfig,
) -> JoinedBlocks:
    """The Gaussians of each block in its cell, the heads and the background of the coarse model,
    and the blocks' mean image model. RunError if a checkpoint cannot be read. Only one block's
    checkpoint at a time is in memory beside the joined model."""
    gaussians, facts, cameras = _joined([coarse, *blocks], plan, scene)
    model, image_model = WholeModel.of(coarse, config)
    image_model.load_state_dict(cameras)
    whole = WholeModel(replace(model, gaussians=gaussians, neighbours=None), image_model)
    return JoinedBlocks(whole, tuple(facts))


def save(
    path: Path, joined: JoinedBlocks, config: TrainConfig, more: Sequence[CheckpointFacts]
) -> None:
    """Write a joined model as a checkpoint, its neighbours searched again; RunError if it fails."""
    model = joined.whole.model
    neighbours = model.field.neighbours_of(model.gaussians.means)
    with seeded(config.seed):
        terms = configured_terms(config, (), model.gaussians.modalities)
    generator = torch.Generator().manual_seed(config.seed)
    state = TrainingState.around(
        replace(model, neighbours=neighbours), terms, config.densification, config,
        joined.facts[0].capture, generator,
    )  # fmt: skip
    state.image_model.load_state_dict(joined.whole.image_model.state_dict())
    state.step, runs = config.max_steps, [*joined.facts, *more]
    facts = runs[0]._replace(
        step=config.max_steps,
        train_seconds=sum(each.train_seconds for each in runs),
        peak_memory_bytes=max(each.peak_memory_bytes for each in runs),
        skipped_steps=sum(each.skipped_steps for each in runs),
    )
    checkpoint.save(path, state, facts)


def _joined(
    runs: Sequence[RunFolder], plan: BlockPlan, scene: Scene
) -> tuple[Gaussians, list[CheckpointFacts], dict[str, Tensor]]:
    """The Gaussians of all, the facts of each run, of which the first is the coarse one, and the
    blocks' mean image model."""
    counts, facts, cameras = [], [], []
    for number, run in enumerate(runs):
        tensors, own, image_model = load_gaussians(run)
        counts.append(len(_rows(tensors["means"], number, plan, scene)))
        facts.append(own)
        cameras.append(image_model)
    shapes = {name: tensor.shape[1:] for name, tensor in tensors.items()}
    del tensors
    joined = {name: torch.empty(sum(counts), *shape) for name, shape in shapes.items()}
    first = 0
    for number, (run, count) in enumerate(zip(runs, counts, strict=True)):
        tensors, _, _ = load_gaussians(run)
        rows = _rows(tensors["means"], number, plan, scene)
        for name, target in joined.items():
            torch.index_select(tensors[name], 0, rows, out=target[first : first + count])
        del tensors
        first += count
    gaussians = Gaussians.from_tensors(joined, model_modalities(facts[0].modalities))
    photos = [len(cell.views) for cell in plan.cells]
    return gaussians, facts, mean_image_model(cameras[0], cameras[1:], photos)


def mean_image_model(
    coarse: Mapping[str, Tensor], blocks: Sequence[Mapping[str, Tensor]], photos: Sequence[int]
) -> dict[str, Tensor]:
    """The image model of a joined model: the mean over its blocks, weighted by their photos; a
    photo's drift only over those that have learned of it, weighted by how often, else the coarse
    model's."""
    found = {}
    for name, start in coarse.items():
        if start.dtype == torch.bool:  # blocks decide nothing of their own
            found[name] = start
            continue
        values = torch.stack([block[name] for block in blocks])
        weights = values.new_tensor(photos).view(-1, *[1] * start.dim())
        if name.startswith(DRIFT):
            visits = torch.stack([block[DRIFT + "visits"] for block in blocks])
            weights = (visits - coarse[DRIFT + "visits"]).clamp_min(0)
        total = weights.sum(dim=0)
        mean = (weights * values).sum(dim=0) / total.clamp_min(1)
        found[name] = torch.where(total > 0, mean, start)
    return found


def load_gaussians(run: RunFolder) -> tuple[dict[str, Tensor], CheckpointFacts, dict[str, Tensor]]:
    """Parameters of the Gaussians in a run's newest checkpoint, its facts, and its image model."""
    tensors, facts, _ = run.load_newest(checkpoint.read)
    gaussians = checkpoint.parameters_of_gaussians(tensors)
    return gaussians, facts, below(tensors, "image_model.")


def _rows(means: Tensor, number: int, plan: BlockPlan, scene: Scene) -> Int64[Tensor, " k"]:
    """What a run contributes: the coarse one, number 0, its background; a block its cell."""
    if number == 0:
        inside = scene.reach.is_background(means)
    else:
        region = plan.cells[number - 1].region
        inside = Part(plan.plane, region, region, scene.reach).contains(means)
    return inside.nonzero()[:, 0]
