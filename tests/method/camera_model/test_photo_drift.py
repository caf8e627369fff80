from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from mrgs.method.camera_model.image_model import ImageModel, ImageModelConfig
from mrgs.method.camera_model.photo_drift import PhotoDrift, part_medians
from mrgs.scene import THERMAL, Blend, Pixels, Rendering
from mrgs.scene.capture import Capture, Viewpoint

YES = torch.tensor(True)
POINTS = tuple(Viewpoint((float(x), 0.0, 0.0), (0.0, 0.0, 1.0)) for x in range(6))
WITH_A_GAP = (*POINTS[:3], None, *POINTS[3:])
TRUE = torch.tensor([0.02, -0.01, 0.03, -0.02, 0.0, -0.02])


def noise(seed: int, size: float = 0.002) -> torch.Tensor:
    return size * torch.randn(12, 16, generator=torch.Generator().manual_seed(seed))


def parts_of(difference: torch.Tensor) -> torch.Tensor:
    return part_medians(torch.zeros(*difference.shape, 1), Pixels(difference[..., None]))


def taught(residuals: list[torch.Tensor], times: int = 20) -> PhotoDrift:
    drift = PhotoDrift(WITH_A_GAP)
    for _ in range(times):
        for row, residual in enumerate(residuals):
            left = parts_of(residual) - drift.offsets()[row]
            drift.learn(row + (row >= 3), left, YES)
    return drift


def test_what_shifts_a_whole_photo_is_found():
    drift = taught([true + noise(row) for row, true in enumerate(TRUE)])
    assert drift.offsets() == pytest.approx((TRUE - TRUE.mean()).numpy(), abs=1e-3)
    assert drift.of(torch.tensor([6])).item() == drift.offsets()[5].item()
    assert drift.offsets().sum().item() == pytest.approx(0.0, abs=1e-7)


def test_what_parts_of_a_photo_disagree_about_is_no_drift():
    half = torch.zeros(12, 16)
    half[:, 8:] = 1.0
    residuals = [true * (1 - 2 * half) + noise(row) for row, true in enumerate(TRUE)]
    assert taught(residuals).offsets().abs().max().item() < 1e-3


def test_without_drift_there_are_no_offsets():
    assert taught([noise(row, 0.02) for row in range(6)]).offsets().abs().max().item() < 2e-3
    assert PhotoDrift(POINTS).offsets().abs().max().item() == 0.0


def test_a_photo_elsewhere_is_expected_at_the_mean():
    drift = taught([true + noise(row) for row, true in enumerate(TRUE)])
    assert drift.expected(POINTS[2]).item() == drift.of(torch.tensor([2])).item()
    assert drift.expected(Viewpoint((0.5, 0.0, 0.0), (0.0, 0.0, 1.0))).item() == 0.0


def test_masked_parts_and_failed_steps_teach_nothing():
    residual = torch.full((12, 16), torch.nan)
    drift = PhotoDrift(POINTS)
    drift.learn(0, parts_of(residual), YES)
    drift.learn(1, parts_of(noise(1)), torch.tensor(False))
    assert drift.visits.sum().item() == 0
    residual[:6] = 0.01
    drift.learn(0, parts_of(residual), YES)
    assert drift.residuals[0].item() == pytest.approx(0.01)
    assert drift.visits.tolist() == [1, 0, 0, 0, 0, 0]


def test_the_image_model_writes_photos_with_their_drift():
    config = ImageModelConfig(thermal_drift=True)
    capture = Capture(POINTS, 1.0, has_celsius=True)
    model = ImageModel(config, capture)
    assert ImageModel(config, replace(capture, has_celsius=False)).thermal_drift is None
    image = torch.rand(12, 16, 1, generator=torch.Generator().manual_seed(3))
    ones = torch.ones(12, 16)
    rendering = Rendering({THERMAL: Blend(image, ones, ones)})
    for _ in range(20):
        for view, true in enumerate(TRUE):
            photo = Pixels(image + true + noise(view)[..., None])
            number = torch.tensor([view])
            residual = model.thermal_residual(model(rendering, number), photo)
            model.learn(view, residual, YES)
    written = [model(rendering, torch.tensor([i]))[THERMAL].image for i in range(6)]
    found = torch.stack([(each - image).mean() for each in written])
    assert found == pytest.approx((TRUE - TRUE.mean()).numpy(), abs=1e-3)
    again = ImageModel(config, capture)
    again.load_state_dict(model.state_dict())
    assert torch.equal(again.thermal_drift.offsets(), model.thermal_drift.offsets())


def test_what_a_photo_masks_is_not_taken_for_drift():
    model = ImageModel(ImageModelConfig(thermal_drift=True), Capture(POINTS, 1.0, has_celsius=True))
    image, ones = torch.full((12, 16, 1), 0.5), torch.ones(12, 16)
    valid = ones > 0
    valid[:, 6:] = False
    photo = Pixels(torch.where(valid[..., None], image + 0.01, 0.0), valid)
    view = torch.tensor([0])
    written = model(Rendering({THERMAL: Blend(image, ones, ones)}), view)
    parts = model.thermal_residual(written, photo)
    assert parts.isnan().sum().item() == 8
    assert parts[~parts.isnan()].tolist() == pytest.approx([0.01] * 8)


def test_what_the_overlap_says_counts_by_its_precision():
    drift = PhotoDrift(POINTS)
    drift.begin(TRUE, torch.full((6,), 1e8))
    assert drift.offsets() == pytest.approx((TRUE - TRUE.mean()).numpy(), abs=1e-4)
    for row in range(6):
        drift.learn(row, parts_of(noise(row, 0.05)), YES)
    assert drift.offsets() == pytest.approx((TRUE - TRUE.mean()).numpy(), abs=1e-3)
    drift = PhotoDrift(POINTS)
    drift.begin(TRUE, torch.ones(6))
    for row in range(6):
        drift.learn(row, parts_of(noise(row)) - drift.offsets()[row], YES)
    assert drift.offsets().abs().max().item() < 0.01


def test_a_held_out_photo_drifts_between_those_before_and_after_it():
    there = Viewpoint((0.5, 0.0, 0.0), (0.0, 0.0, 1.0))
    drift = PhotoDrift(POINTS, [0.0, 1.0, 5.0, 6.0, 7.0, 8.0], [(there, 0.25)])
    drift.begin(TRUE, torch.full((6,), 1e8))
    offsets = drift.offsets()
    assert drift.expected(there).item() == pytest.approx(
        (0.75 * offsets[0] + 0.25 * offsets[1]).item(), abs=1e-6
    )
    elsewhere = Viewpoint((0.3, 0.0, 0.0), (0.0, 0.0, 1.0))
    assert drift.expected(elsewhere).item() == 0.0
