"""Train a scene in blocks: a coarse model, the plan, each block, and the joined model."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Int64
from torch import Tensor

from mrgs.blocks import refinement
from mrgs.blocks.plan import (
    BlockOptions,
    BlockPlan,
    Surveyor,
    config_values,
    make_plan,
    only,
    read_plan,
)
from mrgs.blocks.refinement import Part, Refinement, WholeModel
from mrgs.blocks.region import parse_grid
from mrgs.errors import ConfigError, FolderInUseError
from mrgs.method.config import TrainConfig, with_steps
from mrgs.method.density.adaptive import AdaptiveDensityControl
from mrgs.method.losses.terms import configured_terms
from mrgs.run_files.checkpoint import below, load_facts
from mrgs.run_files.facts import CheckpointFacts, facts_to_resume
from mrgs.run_files.folder import RunFolder
from mrgs.scene import Gaussians, Scene
from mrgs.scene.capture import model_modalities
from mrgs.system.atomic import LOCK, locked
from mrgs.system.gpu import DeviceName
from mrgs.system.torch_modes import seeded
from mrgs.training import checkpoint
from mrgs.training.start import NO_HOOKS, Hooks, TrainOptions, train
from mrgs.training.state import TrainingState

COARSE_STEPS = 0.5
"""Steps of the coarse model, as a share of a block's."""

COARSE_ROUNDS = 4
"""Least steps of the coarse model per photo."""

Follow = Callable[[str], AbstractContextManager[Hooks]]
"""From the title of a training to the hooks that follow it."""


@dataclass(frozen=True, eq=False)
class BlockTraining:
    """A scene that is trained in blocks, into a folder that several processes may share.

    Finished parts are not done again, so that the same call continues what was ended at any moment.

    Attributes:
        folder: of the joined run; blocks are below it.
        config: of the whole; steps and largest number of Gaussians are those of each block.
        options: how it is cut.
        plain: run the plain definitions of all operations.
        say: takes lines for the user.
    """

    scene: Scene
    folder: RunFolder
    config: TrainConfig
    options: BlockOptions
    device: DeviceName = "auto"
    plain: bool = False
    follow: Follow = field(default=lambda title: nullcontext(NO_HOOKS))
    say: Callable[[str], None] = field(default=lambda line: None)

    @property
    def coarse_folder(self) -> RunFolder:
        """The run of the coarse model."""
        return RunFolder(self._below / "coarse")

    def block_folder(self, number: int) -> RunFolder:
        """The run of a block, from 1."""
        return RunFolder(self._below / f"{number:03d}")

    @property
    def _below(self) -> Path:
        return self.folder.path / "blocks"

    @cached_property
    def plan(self) -> BlockPlan:
        """The plan of the blocks; if need be made, after the coarse model, or waited for where
        another process makes it. ConfigError if the scene cannot be cut like this, RunError if the
        folder holds something else, or blocks made otherwise; other errors as for ``train``."""
        path = self._below / "plan.json"
        parse_grid(self.options.blocks)
        if self.config.batch != 1:
            raise ConfigError("blocks are trained with one view per step: leave the batch out")
        if not isinstance(self.config.densification, AdaptiveDensityControl):
            raise ConfigError(
                f"blocks are trained with the density control 'adaptive', not "
                f"{self.config.densification.name!r}: train the whole instead"
            )
        if not self._below.exists():
            self.folder.require_new()
        with self._alone():
            plan = read_plan(path)
            if plan is not None:
                plan.require_same(path, self.scene, self.config, self.options)
                facts_to_resume(self.coarse_folder.load_newest(load_facts), self.scene)
                return plan
            self._train(self.coarse_folder, self._coarse_config, "coarse model of the whole")
            plan = make_plan(
                self.coarse.model, self.scene, config_values(self.config), self.options, self.say
            )
            plan.write(path)
        return plan

    @cached_property
    def coarse(self) -> WholeModel:
        """The coarse model, which must be finished."""
        return WholeModel.of(self.coarse_folder, self._coarse_config)

    @cached_property
    def _surveyor(self) -> Surveyor:
        return Surveyor(self.coarse.model, self.scene, self.plan.plane)

    @property
    def _coarse_config(self) -> TrainConfig:
        steps = max(
            round(COARSE_STEPS * self.config.max_steps), COARSE_ROUNDS * len(self.scene.train)
        )
        return with_steps(self.config, steps)

    def unfinished(self) -> list[int]:
        """The blocks that are left to train, from 1."""
        numbers = range(1, len(self.plan.cells) + 1)
        return [n for n in numbers if not _is_finished(self.block_folder(n), self.config)]

    def train_block(self, number: int) -> None:
        """Train a block, or continue it. ConfigError if there is no such block, FolderInUseError if
        another process trains it; other errors as for ``train``."""
        count = len(self.plan.cells)
        if not 1 <= number <= count:
            raise ConfigError(
                f"there is no block {number}: the scene has {count}, from 1", options=("block",)
            )
        views = len(self.plan.cells[number - 1].views)
        block = refinement.block(self.coarse, self.scene, self.plan, number - 1, self.config)
        title = f"block {number} of {count}, {views} photos"
        self._train(self.block_folder(number), block.config, title, block)

    def train_all(self) -> bool:
        """Train blocks that no other process trains; join all, and return True, once finished."""
        for number in self.unfinished():
            with suppress(FolderInUseError):  # another process trains it
                self.train_block(number)
        return self.join()

    def join(self) -> bool:
        """Write the joined model if all blocks are finished; returns whether they are."""
        if self.unfinished():
            return False
        with self._alone():
            if not self.folder.checkpoints():
                self.folder.start(self.config)
            numbers = range(1, len(self.plan.cells) + 1)
            blocks = [self.block_folder(number) for number in numbers]
            joined = join(self.coarse_folder, blocks, self.plan, self.scene, self.config)
            more = [facts for number in numbers if (facts := self._close_seam(joined, number))]
            # Of all its parts, as other processes may have trained them.
            parts = [RunFolder(file.parent) for file in sorted(self._below.glob("*/config.yaml"))]
            custom = dict.fromkeys(line for part in parts for line in part.custom_parts)
            self.folder.note_custom_parts(custom)
            path = self.folder.checkpoint_file(self.config.max_steps)
            save(path, joined, self.config, more)
        return True

    def _close_seam(self, joined: JoinedBlocks, number: int) -> CheckpointFacts | None:
        """Refine the joined model and image model along a block's edges; None without a seam."""
        if len(self.plan.cells) == 1 or self.plan.overlap == 0:
            return None
        seam = refinement.seam(
            joined.whole, self._surveyor, self.scene, self.plan, number - 1, self.config
        )
        if seam is None:
            return None
        folder = RunFolder(self._below / f"seam-{number:03d}")
        gaussians, rows, fixed = joined.whole.model.gaussians, seam.rows, ~seam.inside
        if folder.checkpoints():
            found, _, _ = load_gaussians(folder)
            if len(found["means"]) != len(rows) or not torch.equal(
                found["means"][fixed], gaussians.means[rows[fixed]]
            ):
                shutil.rmtree(folder.path)  # of blocks that have been trained again since
        self._train(folder, seam.config, f"seam of block {number}, {len(seam.views)} photos", seam)
        found, facts, cameras = load_gaussians(folder)
        for name, tensor in gaussians.tensors().items():
            tensor[rows] = found[name]
        joined.whole.image_model.load_state_dict(cameras)
        return facts

    def _train(
        self, folder: RunFolder, config: TrainConfig, title: str, part: Refinement | None = None
    ) -> None:
        """Train a run to its end, from where it is."""
        if _is_finished(folder, config):
            return
        with folder.locked():  # before anything is computed for a block that another one has
            pass
        scene = self.scene
        if part is not None:
            scene = only(scene, part.part.counted, part.views, self._surveyor)
        options = TrainOptions(bool(folder.checkpoints()), device=self.device, plain=self.plain)
        own = None if part is None else part.training_part
        with self.follow(title) as hooks:
            train(scene, folder.path, config, options, hooks, part=own)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Within this block no other process plans or joins."""
        in_use = FolderInUseError("waiting for another process that prepares or joins the blocks")
        lock = partial(locked, self._below / LOCK, in_use, options=("output",))
        with ExitStack() as stack:
            try:
                stack.enter_context(lock())
            except FolderInUseError as error:
                self.say(str(error))
                stack.enter_context(lock(wait_s=-1))
            yield


def _is_finished(folder: RunFolder, config: TrainConfig) -> bool:
    if not folder.config_file.is_file() or not folder.checkpoints():
        return False
    return folder.load_newest(load_facts).step >= config.max_steps


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
    photo's drift only over those that have learned of it, by how often, else the coarse one's."""
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
