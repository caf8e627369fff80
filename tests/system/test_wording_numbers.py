from __future__ import annotations

import math

import pytest

from mrgs.system.wording import number_text


@pytest.mark.parametrize(
    ("value", "sign", "text"),
    [
        (-1.25, False, "−1.2"),
        (0.04, True, "+0.0"),
        (-0.04, True, "+0.0"),
        (-0.04, False, "0.0"),
        (-0.06, True, "−0.1"),
        (math.inf, False, "inf"),
    ],
)
def test_what_is_shown_as_zero_has_no_minus(value: float, sign: bool, text: str) -> None:
    assert number_text(value, 1, sign=sign) == text
