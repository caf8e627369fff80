"""Whether this system can make a PDF."""

from __future__ import annotations

import pytest

from mrgs.errors import ConfigError
from mrgs.report.write import require_weasyprint


def _missing() -> str:
    """What keeps WeasyPrint from working here; empty if nothing does."""
    try:
        require_weasyprint()
    except ConfigError as error:
        return str(error)
    return ""


needs_pango = pytest.mark.skipif(bool(_missing()), reason=_missing())
