"""Folders of photos, written by hand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.helpers.photos import photo


@pytest.fixture
def photos(tmp_path: Path) -> Callable[..., Path]:
    """Writes a folder of photos: ``photos({"rgb/a.jpg": "jpg", "notes.txt": b"...", "b.jpg":
    ("jpg", {...})})``."""

    def write(files: dict[str, object], name: str = "card") -> Path:
        root = tmp_path / name
        root.mkdir(exist_ok=True)
        for relative, what in files.items():
            path = root / relative
            path.parent.mkdir(parents=True, exist_ok=True)
            kind, options = what if isinstance(what, tuple) else (what, {})
            path.write_bytes(kind if isinstance(kind, bytes) else photo(kind, **options))
        return root

    return write
