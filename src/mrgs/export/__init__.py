"""A baked model into files that other programs open.

The names below are imported on first use, so that the command line can list the formats cheaply.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mrgs.system.lazy import lazy_imports

if TYPE_CHECKING:
    from mrgs.export.formats import FORMATS as FORMATS
    from mrgs.export.formats import Format as Format
    from mrgs.export.job import BakingLoss as BakingLoss
    from mrgs.export.job import baking_loss_db as baking_loss_db
    from mrgs.export.page.write import write_page as write_page
    from mrgs.export.write import export as export

__getattr__, __dir__, __all__ = lazy_imports(__name__)
