"""How much work and memory a fixed small scene takes: a change that doubles either is seen here, on
any machine.

The figures are those measured when they were last written down. Lower them when the work shrinks;
raise them only on purpose.
"""

from __future__ import annotations

import sys
import tracemalloc

import numpy as np
import pytest

from benchmarks.plan import ONE_RUN, Case
from benchmarks.processes import measure_case, warm_up
from benchmarks.stages.rasterizer import FusedPass, PassInStages
from mrgs.kernels.rasterize.cpu.tiles import empty_splats, tile_lists

SMALL = (5_000, 160, 120)
"""Gaussians, width, height."""

VISIBLE = 4_442
PAIRS = 20_978
"""Pairs of a tile and a splat: what the blending walks over, forwards and backwards."""

FUSED_PASS_BYTES = 2_490_000
"""Largest sum of numpy arrays during the fused pass and its backward: records, lists, pairs'
gradients, images."""

STEP_BYTES = 165e6
"""Peak of a process that takes one MrGS step, 20,000 Gaussians, 640×480, above the interpreter with
torch and the kernels' modules loaded."""


@pytest.fixture(scope="module")
def steps() -> PassInStages:
    steps = PassInStages(*SMALL)
    steps.run_all()
    return steps


def test_as_many_gaussians_are_seen(steps):
    assert len(steps.order) == pytest.approx(VISIBLE, rel=0.002)


def test_the_tile_lists_are_as_long(steps):
    assert steps.lists.tile_splats.size == steps.lists.pair_positions.size <= 1.02 * PAIRS


def test_records_are_as_large(steps):
    """One cache line per splat; 4 + 4 bytes of lists and 48 of gradients per pair."""
    lists = steps.lists
    per_pair = (
        lists.tile_splats.nbytes + lists.pair_positions.nbytes + steps.pair_grads.nbytes
    ) / len(lists.tile_splats)
    assert steps.splats.nbytes / len(steps.order) <= 64
    assert per_pair <= 56


def test_records_do_not_lie_across_two_cache_lines(steps):
    for records in (steps.splats, empty_splats(3), empty_splats(100_000)):
        assert records.ctypes.data % 64 == 0
        assert records.flags.c_contiguous


def test_without_gradients_no_pairs_of_gaussians_are_listed(steps):
    """The image's lists are the same; rendering and the median depth need no others."""
    _, width, height = SMALL
    lists = tile_lists(steps.splats, steps.order, 0, width, height)
    assert np.array_equal(lists.tile_splats, steps.lists.tile_splats)
    assert np.array_equal(lists.tile_starts, steps.lists.tile_starts)
    assert lists.pair_positions.size == 0
    assert lists.pair_starts.size == 1


def test_the_fused_pass_allocates_as_little():
    fused = FusedPass(*SMALL)
    fused.forward_backward()
    tracemalloc.start()
    try:
        fused.forward_backward()
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert 0.5 * FUSED_PASS_BYTES < peak < 1.1 * FUSED_PASS_BYTES


@pytest.mark.skipif(
    sys.platform != "linux",
    reason="the peak of a child can be told from that of its imports on Linux",
)
def test_a_step_needs_as_little_memory():
    warm_up(["mrgs"], threads=2)
    result = measure_case(Case("mrgs", 20_000, 640, 480), ONE_RUN, threads=2)
    assert 0.2 * STEP_BYTES < result["peak_bytes"] < 1.25 * STEP_BYTES
