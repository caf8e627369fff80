"""Preparation of a scene from a folder of photos. The names below are imported on first use: the
process that finds the poses needs few of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mrgs.system.lazy import lazy_imports

if TYPE_CHECKING:
    from mrgs.prepare.contract import Preparation as Preparation
    from mrgs.prepare.contract import Progress as Progress
    from mrgs.prepare.contract import Skipped as Skipped
    from mrgs.prepare.contract import StageReport as StageReport
    from mrgs.prepare.georeference import KnownDistance as KnownDistance
    from mrgs.prepare.options import PrepareOptions as PrepareOptions
    from mrgs.prepare.options import parse_known_distance as parse_known_distance
    from mrgs.prepare.options import parse_target as parse_target
    from mrgs.prepare.run import prepare as prepare

__getattr__, __dir__, __all__ = lazy_imports(__name__)
