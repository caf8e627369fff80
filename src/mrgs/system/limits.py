"""Ranges of configuration values."""

from __future__ import annotations

import operator
from collections.abc import Iterable
from contextlib import suppress
from typing import Any, SupportsIndex, cast

from mrgs.errors import ConfigError
from mrgs.system.wording import shown

MOST_STEPS = 10**9
MOST_WIDTH = 4_096
"""Largest width of a hidden layer."""

MOST_WEIGHT = 10**12
"""Largest weight of a loss, or of anything else that multiplies."""

MOST_RATE = 10
"""Largest learning rate."""

MOST_SEED = 2**32 - 1


def require_within(
    config: Any, names: Iterable[str], low: float, high: float, title: str = "{}"
) -> None:
    """Fields of a configuration must be from ``low`` to ``high``, and not NaN; ``title`` is what
    the message calls a field, with {} for its name. ConfigError if a value is outside."""
    for name in names:
        value = getattr(config, name)
        limit = f"at least {low:,}" if not low <= value else f"at most {high:,}"
        if not low <= value <= high:
            raise ConfigError(f"{title.format(name)} must be {limit}, not {shown(value)}")


def whole_number(value: object, name: str) -> int:
    """A whole number of any type, which the message calls by a name. ConfigError if it is not, or
    has more than 128 bits."""
    with suppress(TypeError):
        number = operator.index(cast(SupportsIndex, value))
        if abs(number) < 2**128:
            return number
    raise ConfigError(f"{name} must be a whole number, not {shown(value)}", options=(name,))
