from __future__ import annotations

import pytest

from mrgs.kernels import dense as layers


@pytest.fixture
def memory() -> type[layers.Activations]:
    """A kind of its own, which finds no spares of what ran before."""
    return type("Activations", (layers.Activations,), {"_spare": []})


def test_memory_goes_to_the_next_of_about_the_same_size(memory):
    first = memory(10, 20)
    address = first.array.ctypes.data
    del first
    second = memory(9, 20)
    assert second.array.ctypes.data == address
    assert second.array.shape == (9, 20)


def test_memory_in_use_is_not_shared(memory):
    first, second = memory(10, 20), memory(10, 20)
    first.array[:] = 1
    second.array[:] = 2
    assert (first.array == 1).all()


def test_memory_far_too_large_is_not_taken_and_few_spares_are_kept(memory):
    large = memory(1000)
    address = large.array.ctypes.data
    del large
    assert memory(10).array.ctypes.data != address
    several = [memory(100) for _ in range(5)]
    del several
    assert len(memory._spare) == 2
