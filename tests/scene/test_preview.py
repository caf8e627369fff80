"""Pictures for notebooks."""

from __future__ import annotations

import io

import numpy as np
import torch
from PIL import Image

from mrgs.scene import RGB, THERMAL, Blend, Camera, Rendering, Scene


def opened(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)))


def test_a_rendering_shows_colours_beside_white_hot_temperatures():
    colors, warm = torch.zeros(2, 3, 3), torch.full((2, 3, 1), 0.6)
    colors[..., 0] = 1.0
    warm[0, 0] = torch.nan
    rendering = Rendering({RGB: Blend.of_image(colors), THERMAL: Blend.of_image(warm)})
    picture = opened(rendering._repr_png_())
    assert picture.shape == (2, 6, 3)
    assert (picture[:, :3] == [255, 0, 0]).all()
    assert (picture[1, 3:] == 153).all()
    assert (picture[0, 3] == 0).all()
    assert repr(rendering).startswith("Rendering(rgb: Blend(3×2")


def test_a_view_shows_its_photos_at_one_height():
    camera = Camera.from_fov(8, 6, 60)
    made = Scene.from_arrays(
        [camera],
        rgb=np.full((1, 6, 8, 3), 255, np.uint8),
        celsius=np.array([[[10.0, 30.0]]]),
        thermal_cameras=[camera.resized(2, 1)],
    )
    picture = opened(made.train[0]._repr_png_())
    assert picture.shape == (6, 8 + 12, 3)
    assert picture[0, 8].tolist() == [0, 0, 0]
    assert picture[0, -1].tolist() == [255, 255, 255]
