from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from mrgs_thermonerf.rays import SceneFrame


@pytest.fixture(autouse=True, scope="module")
def one_torch_thread() -> Iterator[None]:
    """On tensors as small as these, starting threads costs more than it saves."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def unit_frame() -> SceneFrame:
    """Centred at the world's origin, its radius one unit."""
    return SceneFrame(
        torch.zeros(3, dtype=torch.float64), radius=1.0, near=0.1, middle=3.0, far=100.0
    )
