"""A report as PDF, with page numbers, by WeasyPrint."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path
from typing import Any

from PIL import ImageFile

from mrgs.errors import ConfigError
from mrgs.system.atomic import replacing

_OR = "or print the page from a browser"


def require_weasyprint() -> Any:
    """Import the package weasyprint, without what it changes in Pillow: photos that are cut off
    would be read as if they were whole. Without HarfBuzz-Subset it makes larger files, and warns.

    Raises:
        ConfigError: it is not installed, or the library Pango that it needs.
    """
    reads_truncated = ImageFile.LOAD_TRUNCATED_IMAGES
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", category=DeprecationWarning, module="weasyprint")
            import weasyprint
    except ImportError:
        raise ConfigError(f'a PDF needs weasyprint: pip install "mrgs[report]"; {_OR}') from None
    except OSError as error:
        raise ConfigError(
            "a PDF needs the library Pango: apt install libpango-1.0-0 libpangoft2-1.0-0 "
            f"libharfbuzz-subset0 ({str(error).splitlines()[0]:.80}); {_OR}"
        ) from None
    finally:
        ImageFile.LOAD_TRUNCATED_IMAGES = reads_truncated
    return weasyprint


def write_pdf(page: Path, path: Path) -> Path:
    """Write a page of one HTML file as PDF; returns the path. Nothing outside the page is fetched.
    ConfigError if weasyprint is not installed, RunError if the file cannot be written."""
    weasyprint = require_weasyprint()
    logging.getLogger("weasyprint").setLevel(logging.CRITICAL)  # style sheets are for browsers too
    fetcher = weasyprint.urls.URLFetcher(allowed_protocols=["data"])
    text = page.read_text(encoding="utf-8")
    with replacing(path) as temporary:
        weasyprint.HTML(string=text, url_fetcher=fetcher).write_pdf(temporary)
    return path
