"""The states that steps and checkpoints start from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from mrgs.data import load_scene
from mrgs.method.config import TrainConfig
from mrgs.method.losses.term import Term
from mrgs.training.state import initial_state
from tests.helpers.threads import one_torch_thread

__all__ = ["one_torch_thread"]


@pytest.fixture
def make_start(small_scene: Path) -> Callable[..., tuple]:
    """The small scene, and the state at step 0 of a configuration."""

    def make(config: TrainConfig, terms: Sequence[Term] = ()) -> tuple:
        scene = load_scene(small_scene)
        return scene, initial_state(scene, config, terms=terms)

    return make
