"""Heads that all blocks train together: ``torchrun ... -m benchmarks.shared_heads SCENE RUN ...``.

``RUN`` holds the blocks of ``mrgs train --blocks``, finished or only planned, of a method with
heads. As many processes as there are blocks train them again into the folder ``RUN-shared``, one
block each, at the same time: the heads learn too, from the sum of all blocks' gradients. The first
process then joins the blocks with these heads. ``python -m benchmarks.block_seams`` compares both.
"""

from __future__ import annotations

import argparse
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from mrgs.blocks import refinement
from mrgs.blocks.plan import BlockPlan, read_plan
from mrgs.blocks.train import BlockTraining
from mrgs.data import load_scene
from mrgs.distributed.launch import Launch
from mrgs.distributed.processes import Processes, joined
from mrgs.method.config import TrainConfig, from_yaml
from mrgs.training import trainer
from mrgs.training.checkpoint_file import read_file, write_file
from mrgs.training.run_folder import RunFolder
from mrgs.training.state import TrainingState
from mrgs.training.view_sums import ViewSums


def main() -> None:
    """Train and join."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.shared_heads")
    parser.add_argument("scene", type=Path)
    parser.add_argument("run", type=Path)
    options = parser.parse_args()
    launch = Launch.from_environment()
    assert launch is not None, "start it by torchrun"
    config = RunFolder(options.run).read_config(from_yaml)
    source, target = options.run / "blocks", options.run.with_name(f"{options.run.name}-shared")
    plan = read_plan(source / "plan.json")
    assert plan is not None
    assert len(plan.cells) == launch.world_size
    with joined(launch) as processes:
        if processes.is_first:
            shutil.copytree(source / "coarse", target / "blocks/coarse")
            shutil.copy(source / "plan.json", target / "blocks")
        processes.share_json()
        _train(options.scene, target, plan, config, processes)
        processes.share_json()
        if processes.is_first:
            _take_heads(RunFolder(target / "blocks/001"), RunFolder(target / "blocks/coarse"))
            _blocks(options.scene, target, plan, config).join()


def _blocks(scene: Path, target: Path, plan: BlockPlan, config: TrainConfig) -> BlockTraining:
    loaded = load_scene(scene, resolution=config.resolution, seed=config.seed)
    return BlockTraining(loaded, RunFolder(target), config, plan.options)


def _train(
    scene: Path, target: Path, plan: BlockPlan, config: TrainConfig, processes: Processes
) -> None:
    """Train this process's block, with the heads of all."""
    rate, local, step = config.optimizer.heads, refinement._local, trainer.training_step

    def with_heads(*arguments: Any) -> TrainConfig:
        own = local(*arguments)
        return replace(own, optimizer=replace(own.optimizer, heads=rate))

    def summed(state: TrainingState, found: ViewSums) -> ViewSums:
        for parameter in state.model.field.parameters():
            own = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
            parameter.grad = processes.all_gather(own).mean(dim=0)
        return found

    refinement._local = with_heads
    trainer.training_step = lambda *arguments: step(*arguments[:4], summed)
    _blocks(scene, target, plan, config).train_block(processes.rank + 1)
    refinement._local, trainer.training_step = local, step


def _take_heads(block: RunFolder, coarse: RunFolder) -> None:
    """Put the heads of a block into the coarse model, from which the joined one takes them."""
    path = coarse.newest_checkpoint()
    tensors, header = read_file(path)
    trained, _ = read_file(block.newest_checkpoint())
    heads = {name: each for name, each in trained.items() if name.startswith("field.")}
    header = {name: value for name, value in header.items() if name != "format"}
    write_file(path, {**tensors, **heads}, header)


if __name__ == "__main__":
    main()
