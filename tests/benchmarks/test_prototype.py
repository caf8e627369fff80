from __future__ import annotations

import pytest

from benchmarks.prototype import CPP_MS, FUSED, MLP, SSIM_CONV, TARGET_RATIO, estimate, factor

SIZE = (50_000, 640, 480)


def timings(fused_ms: float, mlp_ms: float) -> dict:
    return {FUSED: {"median_ms": fused_ms}, MLP: {"median_ms": mlp_ms}}


def test_a_factor_is_the_time_here_over_the_time_there():
    assert factor(MLP, 320, 78.0) == pytest.approx(2.0)
    assert factor(SSIM_CONV, 640, (168 * 300) ** 0.5) == pytest.approx(1.0)


def test_on_the_same_machine_nothing_is_scaled():
    found = estimate(SIZE, {"prototype": timings(fused_ms=80.4, mlp_ms=39.0)})
    assert found.plain_ratio == pytest.approx(1.2)
    assert found.ratios == pytest.approx((1.2, 1.2))
    assert found.verdict == "met"


@pytest.mark.parametrize(
    ("fused_over_target", "verdict"), [(0.4, "met"), (0.8, "undecided"), (1.1, "missed")]
)
def test_the_verdict_names_what_the_range_leaves_open(fused_over_target, verdict):
    """Of two factors, 0.5 and 1, each is applied to the fused pass that was measured beside it."""
    fused_ms = fused_over_target * TARGET_RATIO[SIZE] * CPP_MS[SIZE]
    groups = {"prototype": timings(fused_ms, 19.5), "prototype-avx2": timings(fused_ms, 39.0)}
    found = estimate(SIZE, groups)
    assert found.ratios == pytest.approx((fused_ms / CPP_MS[SIZE], 2 * fused_ms / CPP_MS[SIZE]))
    assert found.verdict == verdict
