from __future__ import annotations

import numpy as np
import pytest
from PIL import Image


@pytest.fixture
def save(tmp_path):
    """Writes bytes, or an image with Pillow, into the test's folder, and gives the path."""

    def write(name: str, content: bytes | np.ndarray):
        path = tmp_path / name
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            Image.fromarray(content).save(path)
        return path

    return write
