"""Numbers as text."""

from __future__ import annotations


def number_text(value: float, decimals: int, *, sign: bool = False) -> str:
    """A number with a proper minus sign, which what is shown as zero never has.

    Args:
        value: of the number.
        decimals: that it is rounded to.
        sign: whether other numbers have a plus sign.
    """
    text = f"{round(value, decimals) + 0.0:{'+' if sign else ''}.{decimals}f}"
    return text.replace("-", "−")
