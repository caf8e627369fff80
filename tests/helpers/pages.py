"""What an exported page shows and tells in a browser."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from PIL import Image

from mrgs.scene import Camera

SETTLED = "#view[data-settled=true]"
"""The picture, once it is drawn as it stays."""


def fitted(camera: Camera, width: int, height: int) -> Camera:
    """The camera whose image the page shows on a canvas of this size: the whole frame, centred."""
    scale = min(width / camera.width, height / camera.height)
    K = camera.K * scale
    K[0, 2] += (width - scale * camera.width) / 2
    K[1, 2] += (height - scale * camera.height) / 2
    K[2, 2] = 1
    return Camera(K, camera.viewmat, width, height)


def picture(page: Any) -> np.ndarray:
    """The picture alone, without what lies over it."""
    show = "(nodes, visibility) => nodes.forEach((node) => { node.style.visibility = visibility; })"
    over = page.locator("#scales, .tools, #tip, #marks")
    over.evaluate_all(show, "hidden")
    content = page.locator("#view").screenshot()
    over.evaluate_all(show, "")
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"), dtype=np.float64)


def shown(page: Any, modality: str) -> np.ndarray:
    """The picture of a modality."""
    page.click(f"[data-modality={modality}]")
    page.wait_for_selector(SETTLED)
    return picture(page)


def psnr(got: np.ndarray, expected: np.ndarray) -> float:
    return 10 * np.log10(255**2 / np.square(got - expected).mean())


def read(page: Any, x: int, y: int) -> tuple[float, float]:
    """The value and the depth that the page shows under the cursor."""
    box = page.locator("#view").bounding_box()
    page.locator("#value").evaluate("element => { element.dataset.value = 'asked'; }")
    page.mouse.move(box["x"] + x + 0.5, box["y"] + y + 0.5)
    page.wait_for_selector("#value:not([data-value=asked])")
    value = page.locator("#value")
    return float(value.get_attribute("data-value")), float(value.get_attribute("data-depth"))
