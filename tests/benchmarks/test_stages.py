from __future__ import annotations

import pytest
import torch

from benchmarks.calibration import ARITHMETIC, MEMORY
from benchmarks.child import prepare, result_of
from benchmarks.plan import GROUPS, ONE_RUN, SMALLEST
from benchmarks.report import CALIBRATIONS
from benchmarks.stages import prototype
from benchmarks.stages.gsplat_torch import transmittance_before
from benchmarks.targets import TARGETS
from benchmarks.timing import SkippedError


def test_the_calibration_goes_by_one_name():
    assert (ARITHMETIC, MEMORY) == CALIBRATIONS


@pytest.mark.parametrize("name", [name for name in GROUPS if name != "gsplat"])
def test_every_stage_runs_at_the_smallest_size(name):
    result = result_of(GROUPS[name].case(*SMALLEST), ONE_RUN, base_bytes=0)
    stages = set(result["timings"]) - set(CALIBRATIONS)
    assert stages
    assert all(timing["median_ms"] > 0 for timing in result["timings"].values())
    assert {target.timing for target in TARGETS if target.group == name and target.timing} <= stages


def test_gsplat_draws_the_same_image():
    try:
        stages = prepare(GROUPS["gsplat"].case(*SMALLEST))
    except SkippedError as reason:
        pytest.skip(str(reason))
    differences = {
        name: value for name, value in stages.notes.items() if name.startswith("difference")
    }
    assert len(differences) == 4
    assert all(float(value.split()[1].rstrip(",")) < 1e-5 for value in differences.values())
    for timing in stages.timings:
        timing.run(timing.setup())


def test_a_case_that_cannot_be_measured_says_why():
    def unavailable(case):
        raise SkippedError("not here")

    case = GROUPS["adam"].case(*SMALLEST)
    assert result_of(case, ONE_RUN, 0, prepare=unavailable) == {"skipped": "not here"}


def test_an_error_is_no_reason_to_skip():
    def broken(case):
        raise RuntimeError("wrong shape")

    with pytest.raises(RuntimeError, match="wrong shape"):
        result_of(GROUPS["losses"].case(*SMALLEST), ONE_RUN, 0, prepare=broken)


def test_a_densification_event_starts_from_the_same_state_each_time():
    (timing,) = prepare(GROUPS["densification"].case(*SMALLEST)).timings
    counts = []
    for _ in range(2):
        state = timing.setup()
        before = len(state.model.gaussians)
        timing.run(state)
        counts.append((before, len(state.model.gaussians)))
    assert counts[0] == counts[1]
    assert counts[0][0] == SMALLEST[0]
    assert 1.05 * SMALLEST[0] < counts[0][1] < 1.15 * SMALLEST[0]
    assert len(state.model.neighbours) == counts[0][1]


def test_both_windows_of_the_known_ssim_are_the_same():
    planes = torch.rand(4, 20, 30, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(
        prototype.window_by_convolution(planes), prototype.window_by_shifts(planes)
    )


def test_transmittance_of_each_ray():
    alpha = torch.tensor([0.5, 0.25, 0.9, 0.999, 0.1])
    found = transmittance_before(alpha, torch.tensor([0, 0, 0, 2, 2]), rays=4)
    torch.testing.assert_close(found, torch.tensor([1.0, 0.5, 0.375, 1.0, 0.001]))
