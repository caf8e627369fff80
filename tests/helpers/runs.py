"""What is costly to make is made once per session, whatever the number of workers."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock

from mrgs.method.config import TrainConfig, make_config
from mrgs.training import train

SMALL = make_config("mrgs", max_steps=60, max_gaussians=300)
"""Of the small scene: trained for a moment, so that there is something to see. A test that has no
reason for another takes this one, and shares its run."""


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A folder that the first worker to ask for it fills; only to be read."""
    base = factory.getbasetemp()
    root = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder, done = root / name, root / f"{name}.done"
    with FileLock(root / f"{name}.lock"):
        if not done.exists():
            make(folder)
            done.touch()
    return folder


def trained_run(
    factory: pytest.TempPathFactory, scene: Path, config: TrainConfig, output: Path
) -> Path:
    """A run of its own at ``output``: the copy of one that is trained once per session."""
    key = hashlib.sha256(f"{scene} {config!r}".encode()).hexdigest()[:16]
    folder = made_once(factory, f"run_{key}", lambda path: train(scene, path, config))
    return shutil.copytree(folder, output)
