from __future__ import annotations

from tests.prepare.conftest import photos

__all__ = ["photos"]
