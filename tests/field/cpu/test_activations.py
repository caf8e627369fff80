from __future__ import annotations

import pytest

from mrgs.kernels.dense.activations import Activations


@pytest.fixture(autouse=True)
def _no_spares(monkeypatch):
    monkeypatch.setattr(Activations, "_spare", [])


def test_memory_goes_to_the_next_of_about_the_same_size():
    first = Activations(10, 20)
    address = first.array.ctypes.data
    del first
    second = Activations(9, 20)
    assert second.array.ctypes.data == address
    assert second.array.shape == (9, 20)


def test_memory_in_use_is_not_shared():
    first, second = Activations(10, 20), Activations(10, 20)
    first.array[:] = 1
    second.array[:] = 2
    assert (first.array == 1).all()


def test_memory_far_too_large_is_not_taken_and_few_spares_are_kept():
    large = Activations(1000)
    address = large.array.ctypes.data
    del large
    assert Activations(10).array.ctypes.data != address
    several = [Activations(100) for _ in range(5)]
    del several
    assert len(Activations._spare) == 2
