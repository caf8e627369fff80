"""What several views have measured, added up."""

from __future__ import annotations

import math

import pytest
import torch

from mrgs.training.step import LOSS, THERMAL_ERROR, ViewSums
from mrgs.training.view_pass import ViewMeasures


def summed(*views: tuple[float, dict[str, float], float | None]) -> ViewSums:
    """Sums over views, each with its loss, its terms and its thermal error."""
    found = ViewSums()
    for loss, terms, error in views:
        values = {name: torch.tensor(value) for name, value in terms.items()}
        known = None if error is None else torch.tensor(error)
        measures = ViewMeasures(torch.tensor(loss), values, known, None, ())
        found.add(0, measures, {"gradients": torch.tensor([1.0, loss])})
    return found


def test_each_number_is_the_mean_over_the_views_that_have_it():
    sums = summed(
        (1.0, {"rgb": 0.1, "thermal": 0.4}, 0.2),
        (2.0, {"rgb": 0.3}, None),
        (6.0, {"rgb": 0.5, "thermal": 0.6}, math.nan),  # no valid pixel
    )
    assert sums.mean(LOSS) == pytest.approx(3.0)
    assert sums.mean(THERMAL_ERROR) == pytest.approx(0.2)
    assert {name: float(value) for name, value in sums.terms.items()} == pytest.approx(
        {"rgb": 0.3, "thermal": 0.5}
    )
    assert sums.observed["gradients"].tolist() == [3.0, 9.0]


def test_what_no_view_has_is_not_there():
    sums = summed((1.0, {"rgb": 0.1}, None))
    assert sums.mean(THERMAL_ERROR) is None
    assert sums.terms.keys() == {"rgb"}
