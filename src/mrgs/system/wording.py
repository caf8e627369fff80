"""Parts of sentences for the user, and sentences that can be translated."""

from __future__ import annotations

import reprlib
import shlex
from collections.abc import Iterable, Sequence
from typing import Any

from mrgs.errors import printable


def shown(value: Any) -> str:
    """A value from a file or a caller: shortened, on one line."""
    try:
        return reprlib.repr(value)
    except ValueError:  # an integer of thousands of digits
        return "a number of too many digits"


def quoted(text: object) -> str:
    """A word of a command to be pasted into a shell, as Bash's $'…' where not all is printable."""
    word = str(text)
    if word.isprintable():
        return shlex.quote(word)
    escaped = (
        f"\\{each}" if each in "\\'"
        else f"\\x{ord(each) - 0xDC00:02x}" if "\udc80" <= each <= "\udcff"
        else printable(each)
        for each in word
    )  # fmt: skip
    return f"$'{''.join(escaped)}'"


def counted(number: int, noun: str) -> str:
    """A number of things: "1 view", "1,200 views"."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def listed(names: Sequence[str], most: int = 3) -> str:
    """The first names, and how many more there are."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def aligned(rows: Sequence[Sequence[str]], left: Iterable[int]) -> list[str]:
    """Lines of a table with columns of equal width; the ``left`` ones are texts, others numbers."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    left = set(left)
    return [
        "  ".join(
            cell.ljust(width) if place in left else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


class Message(str):
    """An English template with formatted values in place of each ``{name}``; anything that reads
    texts can read it."""

    template: str
    values: dict[str, str]

    def __new__(cls, template: str, **values: str) -> Message:  # noqa: D102
        message = super().__new__(cls, template.format(**values) if values else template)
        message.template, message.values = template, values
        return message


def number_text(value: float, decimals: int, *, sign: bool = False) -> str:
    """A rounded number with a proper minus sign, but none before zero; ``sign`` adds plus signs."""
    text = f"{round(value, decimals) + 0.0:{'+' if sign else ''}.{decimals}f}"
    return text.replace("-", "−")
