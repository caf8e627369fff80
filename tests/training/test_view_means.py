"""What several views have measured, as means."""

from __future__ import annotations

import math

import pytest
import torch

from mrgs.training.step import means
from mrgs.training.view_pass import ViewMeasures


def measured(loss: float, terms: dict[str, float], error: float | None) -> ViewMeasures:
    """The measures of a view: its loss, its terms and its thermal error."""
    values = {name: torch.tensor(value) for name, value in terms.items()}
    known = None if error is None else torch.tensor(error)
    return ViewMeasures(torch.tensor(loss), values, known, None, ())


def test_each_number_is_the_mean_over_the_views_that_have_it():
    loss, terms, error = means(
        [
            measured(1.0, {"rgb": 0.1, "thermal": 0.4}, 0.2),
            measured(2.0, {"rgb": 0.3}, None),
            measured(6.0, {"rgb": 0.5, "thermal": 0.6}, math.nan),  # no valid pixel
        ]
    )
    assert loss == pytest.approx(3.0)
    assert error == pytest.approx(0.2)
    found = {name: float(value) for name, value in terms.items()}
    assert found == pytest.approx({"rgb": 0.3, "thermal": 0.5})


def test_what_no_view_has_is_not_there():
    _, terms, error = means([measured(1.0, {"rgb": 0.1}, None)])
    assert error is None
    assert terms.keys() == {"rgb"}
