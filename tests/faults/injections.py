"""Values that no training makes, put into one that runs: what is saved stays finite."""

from __future__ import annotations

import math
import random
import shutil
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from mrgs.errors import TrainingError
from mrgs.run_files.folder import RunFolder
from mrgs.training import loop, train
from mrgs.training.checkpoint import tensors_of
from mrgs.training.start import TrainOptions
from tests.faults.program import small_scene
from tests.faults.runs import GAUSSIANS
from tests.faults.tally import Tally

VALUES = (math.nan, math.inf, -math.inf, 3e38, -3e38, 1e30)
SHARE_OF_PHOTOS = 0.15


def values(folder: Path, count: int, seed: int = 0) -> Tally:
    """Put a value into one tensor of a training at one step, ``count`` times: into parameters,
    moments, statistics, the model of the camera, photos; into one element or all."""
    rng, tally, stopped = random.Random(seed), Tally(), 0
    scene = small_scene(folder / "scene")
    base = train(scene, folder / "base", GAUSSIANS)
    base.newest_checkpoint().unlink()
    for number in range(count):
        run = RunFolder(shutil.copytree(base.path, folder / "run"))
        with _injecting(rng) as what:
            outcome = _go_on(scene, run)
        spoilt = [f"{path.name}: {name}" for path in run.checkpoints() for name in not_finite(path)]
        held = outcome in ("finished", "stopped") and not spoilt
        tally.judge(f"{number}: {' '.join(what)}", held, f"{outcome} {spoilt[:3]}")
        stopped += outcome == "stopped"
        shutil.rmtree(run.path)
    tally.figure = f"{stopped} trainings stopped with the last good checkpoint, the others went on"
    return tally


@contextmanager
def _injecting(rng: random.Random) -> Iterator[list[str]]:
    """Within this block one step of a training finds a value where it should not be; gives what was
    put where, once it is done."""
    at, value, everywhere = rng.randint(5, 9), rng.choice(VALUES), rng.random() < 0.3
    into_photos, place = rng.random() < SHARE_OF_PHOTOS, rng.random()
    what: list[str] = []
    original: Callable[..., Any] = loop.training_step

    def training_step(state: Any, views: Any, *rest: Any) -> Any:
        if state.step == at:
            tensors = _photos(views) if into_photos else _state(state)
            name = rng.choice(sorted(tensors))
            what[:] = [name, f"{value:g}", "all" if everywhere else "one", f"step {at + 1}"]
            put(tensors[name], value, everywhere, place)
        return original(state, views, *rest)

    loop.training_step = training_step
    try:
        yield what
    finally:
        loop.training_step = original


def _photos(views: Any) -> dict[str, Tensor]:
    return {f"photo {modality}": pixels.values for modality, pixels in views[0].photos.items()}


def _state(state: Any) -> dict[str, Tensor]:
    return {
        name: tensor
        for name, tensor in tensors_of(state).items()
        if tensor.is_floating_point() and tensor.numel()
    }


def put(tensor: Tensor, value: float, everywhere: bool, place: float = 0.5) -> None:
    """Into all elements, or the one at a place from 0 to 1."""
    with torch.no_grad():
        if everywhere:
            tensor.fill_(value)
        else:
            tensor.view(-1)[int(place * tensor.numel())] = value


def _go_on(scene: Path, run: RunFolder) -> str:
    """How the training from step 5 to 10 ends."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            train(scene, run.path, GAUSSIANS, options=TrainOptions(resume=True))
        except TrainingError as error:
            return "stopped" if "\n" not in str(error) else f"many lines: {error}"
        except Exception as error:  # whatever it is, it is a finding
            return repr(error)
    return "finished"


def not_finite(path: Path) -> list[str]:
    """Names of the tensors of a checkpoint that are not finite."""
    return [
        name
        for name, tensor in load_file(path).items()
        if tensor.is_floating_point() and not tensor.isfinite().all()
    ]
