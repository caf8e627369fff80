"""The page that shows what was understood of a set of photos, or of a scene made elsewhere."""

from mrgs.prepare.page.write import PAGE, write_page

__all__ = ["PAGE", "write_page"]
