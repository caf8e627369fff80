"""Numbers as text."""

from __future__ import annotations


def number_text(value: float, decimals: int, *, sign: bool = False) -> str:
    """A rounded number with a proper minus sign, but none before zero; ``sign`` adds plus signs."""
    text = f"{round(value, decimals) + 0.0:{'+' if sign else ''}.{decimals}f}"
    return text.replace("-", "−")
