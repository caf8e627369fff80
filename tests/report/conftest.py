"""The house front whose size and temperatures are known."""

from __future__ import annotations

from tests.export.maps.conftest import front, front_scene

__all__ = ["front", "front_scene"]
