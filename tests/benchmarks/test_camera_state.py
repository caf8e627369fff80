"""What a run has learned of a camera is compared up to a constant."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.camera_state import agreement


def test_a_constant_is_no_error_and_a_wrong_sign_is_twice_the_drift() -> None:
    done_c = np.array([-3.0, -1.0, 0.0, 0.5])
    assert agreement(done_c, done_c + 2.0) == pytest.approx((done_c.std(), 0.0))
    assert agreement(done_c, -done_c).error_c == pytest.approx(2.0 * done_c.std())
