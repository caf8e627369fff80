"""From a folder of photos to a scene.

The names below are imported on first use: the process that finds the poses needs few of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mrgs.prepare.contract import LeftOut, Preparation, Progress, StageReport
    from mrgs.prepare.georeference import KnownDistance
    from mrgs.prepare.options import PrepareOptions, parse_known_distance, parse_target
    from mrgs.prepare.run import prepare

_HOMES = {
    "KnownDistance": "georeference",
    "LeftOut": "contract",
    "Preparation": "contract",
    "PrepareOptions": "options",
    "Progress": "contract",
    "StageReport": "contract",
    "parse_known_distance": "options",
    "parse_target": "options",
    "prepare": "run",
}

__all__ = [
    "KnownDistance",
    "LeftOut",
    "Preparation",
    "PrepareOptions",
    "Progress",
    "StageReport",
    "parse_known_distance",
    "parse_target",
    "prepare",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'mrgs.prepare' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"mrgs.prepare.{_HOMES[name]}"), name)
