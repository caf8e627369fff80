"""Small fields and short schedules."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch

from mrgs.baselines.thermonerf import ThermoNerfConfig
from mrgs.baselines.thermonerf.field import FieldConfig
from mrgs.baselines.thermonerf.frame import Frame
from mrgs.baselines.thermonerf.hash_grid import HashGridConfig
from mrgs.baselines.thermonerf.sampling import SamplingConfig


@pytest.fixture(autouse=True, scope="module")
def one_torch_thread() -> Iterator[None]:
    """On tensors as small as these, starting threads costs more than it saves."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def small_config(max_steps: int = 20, **changes: Any) -> ThermoNerfConfig:
    """Small grids and few rays."""
    config = ThermoNerfConfig(
        max_steps=max_steps,
        rays_per_batch=256,
        field=FieldConfig(grid=HashGridConfig(4, 4, 64, 12), hidden_width=16),
        proposal=HashGridConfig(3, 4, 32, 10),
        sampling=SamplingConfig(proposal=24, field=12),
    )
    return replace(config, **changes)


@pytest.fixture(scope="session")
def make_small_config() -> Callable[..., ThermoNerfConfig]:
    return small_config


@pytest.fixture(scope="session")
def unit_frame() -> Frame:
    """Centred at the world's origin, its radius one unit."""
    return Frame(torch.zeros(3, dtype=torch.float64), radius=1.0, near=0.1, middle=3.0, far=100.0)
