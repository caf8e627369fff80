"""Long arrays in pieces, so that what is made of them takes little memory."""

from __future__ import annotations

from collections.abc import Iterator

PIECE_ROWS = 65_536


def pieces(count: int) -> Iterator[slice]:
    """The rows 0 to ``count`` in order, ``PIECE_ROWS`` at a time; one empty piece of none."""
    for start in range(0, max(count, 1), PIECE_ROWS):
        yield slice(start, min(start + PIECE_ROWS, count))
