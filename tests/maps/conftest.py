"""A house front of known size and temperatures, photographed from a known model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mrgs.field.spherical_harmonics import C0
from mrgs.rasterizer.contract import Dilation
from mrgs.runs.baked import BakedModel
from mrgs.scene import (
    RGB,
    THERMAL,
    Camera,
    EarthPosition,
    Scene,
    TemperatureRange,
    WorldFrame,
)

CELSIUS = TemperatureRange(-10.0, 30.0)
WALL_C, WINDOW_C, GROUND_C = 2.0, 20.0, -4.0
WIDTH, HEIGHT = 8.0, 5.0
WINDOWS = ((-3.0, -1.0, 1.0, 3.0), (1.0, 3.0, 1.0, 3.0))
"""Left, right, bottom, top, metres; the wall's face is y = 0, seen from negative y."""

MUNICH = WorldFrame(True, True, EarthPosition(48.137, 11.575, 520.0), 0.8)
PIXEL = 0.05


def plane(u: np.ndarray, v: np.ndarray, upright: bool) -> np.ndarray:
    u, v = (axis.ravel() for axis in np.meshgrid(u, v))
    return np.stack([u, np.zeros_like(u), v] if upright else [u, v, np.zeros_like(u)], axis=1)


def middles(low: float, high: float, step: float) -> np.ndarray:
    return np.arange(low + step / 2, high, step)


@pytest.fixture(scope="session")
def front() -> BakedModel:
    """The wall with two windows, the ground before it, and a splat that floats before the wall."""
    wall = plane(middles(-WIDTH / 2, WIDTH / 2, 0.05), middles(0, HEIGHT, 0.05), True)
    ground = plane(middles(-4, 4, 0.08), middles(-4, 0, 0.08), False)
    window = np.zeros(len(wall), bool)
    for left, right, bottom, top in WINDOWS:
        window |= (
            (wall[:, 0] > left) & (wall[:, 0] < right) & (wall[:, 2] > bottom) & (wall[:, 2] < top)
        )
    floating = np.array([[0.0, -9.5, 2.5]])  # behind the cameras
    means = np.concatenate([wall, ground, floating])
    celsius = np.concatenate(
        [np.where(window, WINDOW_C, WALL_C), np.full(len(ground), GROUND_C), [30.0]]
    )
    scales = np.concatenate(
        [
            np.tile([0.045, 0.005, 0.045], (len(wall), 1)),
            np.tile([0.07, 0.07, 0.005], (len(ground), 1)),
            [[1.0, 1.0, 1.0]],
        ]
    )
    count = len(means)
    sh = torch.zeros(count, 16, 3)
    colors = np.where(np.arange(count)[:, None] < len(wall), [0.8, 0.5, 0.2], [0.3, 0.3, 0.3])
    sh[:, 0] = torch.from_numpy((colors - 0.5) / C0)
    opacities = torch.full((count,), 0.999)
    return BakedModel(
        torch.from_numpy(means).float(),
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.from_numpy(scales).float(),
        {RGB: opacities, THERMAL: opacities},
        {RGB: sh[:, :1]},
        {RGB: sh[:, 1:]},
        torch.from_numpy(CELSIUS.from_celsius(celsius)).float(),
        CELSIUS,
        dilation=Dilation(),
    )


@pytest.fixture(scope="session")
def front_scene(front: BakedModel) -> Scene:
    """Seven photos of it, the model's renderings with noise, in metres, at a place in Munich."""
    lens = Camera.from_fov(320, 240, 70)
    cameras = [
        lens.look_at((x, -7.0 + 0.1 * abs(x), 1.6), (0.3 * x, 0.0, 2.0))
        for x in np.linspace(-4, 4, 7)
    ]
    noise = np.random.default_rng(0)
    photos = [front.render(camera) for camera in cameras]
    celsius = [
        CELSIUS.to_celsius(photo[THERMAL].image[..., 0].numpy())
        + noise.normal(0, 0.1, (240, 320)).astype(np.float32)
        for photo in photos
    ]
    scene = Scene.from_arrays(
        cameras,
        rgb=[photo[RGB].image.numpy().clip(0, 1) for photo in photos],
        celsius=celsius,
        points=front.means[::4].numpy(),
        eval_every=0,
        name="front",
    )
    return replace(scene, world=MUNICH)


@pytest.fixture(scope="session")
def few_photos(front_scene: Scene) -> Scene:
    """Three of its photos, for what does not depend on how many there are."""
    return replace(front_scene, train=front_scene.train[::3])
