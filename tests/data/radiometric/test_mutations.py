"""Whatever happens to the bytes of a thermal photo, the answer is a photo whose mask is true, or a
SceneError.

``MRGS_MUTATIONS`` sets how many damaged files are tried (5,000 take some minutes),
``MRGS_MUTATION_SEED`` which.
"""

from __future__ import annotations

import io
import os
import random
import struct
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from PIL import Image

from mrgs.data.radiometric import read_thermal_photo
from mrgs.errors import SceneError
from tests.helpers.flir import FlirPhoto

MUTATIONS = int(os.environ.get("MRGS_MUTATIONS", "400"))
SEED = int(os.environ.get("MRGS_MUTATION_SEED", "0"))
PHOTOS = Path(__file__).parents[4] / "shared/radiometric"

T = TypeVar("T")

ODD_FLOATS = (
    0.0,
    -1.0,
    1e-30,
    1e30,
    -1e30,
    float("nan"),
    float("inf"),
    float("-inf"),
    293.15,
    1400.0,
)
ODD_WORDS = [struct.pack(f"{order}f", value) for value in ODD_FLOATS for order in "<>"] + [
    struct.pack(f"{order}I", value)
    for value in (1, 31, 32, 65_535, 2**20, 2**31 - 1, 2**32 - 1)
    for order in "<>"
]


def mutate(data: bytes, rng: random.Random) -> bytes:
    """Up to four injuries; half of them near the start, where headers and constants lie."""
    mutated = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(min(len(mutated), 4096) if rng.random() < 0.5 else len(mutated))
        match rng.randrange(7):
            case 0:
                mutated[at] = rng.randrange(256)
            case 1 | 2:
                at -= at % 4
                mutated[at : at + 4] = rng.choice(ODD_WORDS)
            case 3:
                del mutated[at : at + rng.randint(1, 64)]
            case 4:
                mutated[at:at] = mutated[at : at + rng.randint(1, 64)]
            case 5:
                mutated[at : at + 64] = rng.randbytes(rng.randint(1, 64))
            case 6:
                del mutated[max(at, len(mutated) // 4) :]
        if not mutated:
            break
    return bytes(mutated)


def or_error(read: Callable[[], T]) -> T | None:
    """What is read; None for a SceneError of one line. Any other exception is let through."""
    message = ""
    try:
        return read()
    except SceneError as error:
        message = str(error)
    assert message
    assert "\n" not in message
    return None


def is_read_or_refused(path: Path) -> bool:
    """Whether a photo was read; fails where its mask is wrong."""
    photo = or_error(lambda: read_thermal_photo(path))
    if photo is None:
        return False
    values = photo.relative if photo.temperature_c is None else photo.temperature_c
    np.testing.assert_array_equal(np.isfinite(values), photo.valid)
    assert photo.valid.any()
    if photo.facts.visible is not None:
        or_error(photo.facts.visible.pixels)
    return True


def image_bytes(pixels: np.ndarray, form: str) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, form)
    return file.getvalue()


@pytest.fixture
def originals() -> list[tuple[str, bytes]]:
    """Whole files of every kind, by extension: FLIR's as a photo and as a bare record."""
    visible = image_bytes(np.full((24, 32, 3), 90, dtype=np.uint8), "PNG")
    written = [
        FlirPhoto(),
        FlirPhoto(storage="swapped png", visible=visible),
        FlirPhoto(order=">", part_bytes=2000),
    ]
    files = [(".jpg", photo.jpeg()) for photo in written] + [
        (".fff", photo.record()) for photo in written
    ]
    celsius = np.linspace(5, 30, 600, dtype=np.float32).reshape(20, 30)
    files += [
        (".tif", image_bytes(celsius, "TIFF")),
        (".png", image_bytes((100 * celsius).astype(np.uint16), "PNG")),
    ]
    files.append((".csv", "\n".join(";".join(f"{v:.1f}" for v in row) for row in celsius).encode()))
    return files


def test_damaged_files(originals, tmp_path):
    real = sorted(PHOTOS.glob("*.jpg")) if PHOTOS.is_dir() else []
    files = originals + [(".jpg", path.read_bytes()) for path in real]
    rng = random.Random(SEED)
    read = 0
    for _ in range(MUTATIONS):
        suffix, data = rng.choice(files)
        damaged = mutate(data, rng)
        if suffix == ".fff" and rng.random() < 0.5:  # damage inside a whole envelope goes deeper
            suffix, damaged = ".jpg", FlirPhoto().jpeg(damaged) if damaged else b""
        path = tmp_path / f"damaged{suffix}"
        path.write_bytes(damaged)
        read += is_read_or_refused(path)
    assert 0.05 * MUTATIONS < read < 0.95 * MUTATIONS
