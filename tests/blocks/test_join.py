"""What a joined model takes from its blocks besides their Gaussians."""

from __future__ import annotations

import torch

from mrgs.blocks.train import mean_image_model


def cameras(log_sigma: float, residuals: list[float], visits: list[float]) -> dict:
    return {
        "log_sigma": torch.tensor(log_sigma),
        "thermal_drift.residuals": torch.tensor(residuals),
        "thermal_drift.visits": torch.tensor(visits),
    }


def test_drift_is_taken_from_the_blocks_that_saw_the_photo():
    coarse = cameras(9.0, [1.0, 1.0, 1.0, 5.0], [2, 2, 2, 2])
    left = cameras(1.0, [3.0, 3.0, 1.0, 5.0], [6, 4, 2, 2])
    right = cameras(4.0, [1.0, 6.0, 8.0, 5.0], [2, 6, 9, 2])
    joined = mean_image_model(coarse, [left, right], [20, 10])
    assert joined["log_sigma"].item() == 2.0
    assert joined["thermal_drift.residuals"].tolist() == [3.0, 5.0, 8.0, 5.0]
