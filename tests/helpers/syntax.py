"""A fixture for tests that read sources."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True, scope="module")
def without_collector() -> Iterator[None]:
    """Syntax trees are so many objects that looking for cycles among them takes longer than to
    parse."""
    gc.disable()
    yield
    gc.enable()
