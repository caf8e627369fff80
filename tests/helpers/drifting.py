"""Photos of a floor whose temperature is known, by a camera that drifts and shades."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
import torch

from mrgs.scene import THERMAL, Camera, Scene
from mrgs.scene.radiometry import PhotoRecord

WIDTH, HEIGHT = 64, 48
PHOTOS, PAUSE = 24, 14
"""Number of photos, and of those before a pause of five minutes."""


def floor_celsius(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """°C of the floor z = 0."""
    return 15 + torch.sin(2.0 * x) + 0.7 * torch.cos(3.0 * y) + 0.1 * x


def offsets_c() -> torch.Tensor:
    """Of each photo: climbing by 1.5 °C, and after the pause from 5 °C lower; of sum zero."""
    before = torch.linspace(1.0, 2.5, PAUSE).double()
    after = torch.linspace(-4.0, -0.5, PHOTOS - PAUSE).double()
    found = torch.cat([before, after])
    return found - found.mean()


def shading_c() -> torch.Tensor:
    """Of each pixel [H, W]: corners 1.5 °C colder than the middle, the left edge 0.4 °C warmer than
    the right one; of mean zero."""
    x = (torch.arange(WIDTH).double() + 0.5) * 2 / WIDTH - 1
    y = ((torch.arange(HEIGHT).double() + 0.5) * 2 / HEIGHT - 1) * 0.75
    radius2 = x[None] ** 2 + y[:, None] ** 2
    found = -0.7 * radius2 - 0.2 * radius2**2 - 0.2 * x
    return found - found.mean()


def smeared_lines(x: torch.Tensor) -> torch.Tensor:
    """Hot lines every metre of the floor, 0 to 1, as a lens shows them that smears the more the
    farther from the middle of the image."""
    radius2 = sum(grid.square() for grid in torch.meshgrid(
        torch.linspace(-0.75, 0.75, HEIGHT), torch.linspace(-1, 1, WIDTH), indexing="ij"
    ))  # fmt: skip
    return torch.exp(-0.5 * ((x - x.round()) / 0.05) ** 2) * (1 - 0.5 * radius2)


def drifting_scene(
    drift: float = 1.0, shading: float = 1.0, noise_c: float = 0.03, lines_c: float = 0.0
) -> Scene:
    """The scene, with so many times the offsets and the shading, and lines that are so much hotter,
    on which half of the points lie; all views are for training."""
    rng = np.random.default_rng(4)
    noise = torch.Generator().manual_seed(5)
    cameras, images = [], []
    for offset in drift * offsets_c():
        at, towards = rng.uniform(-1.0, 1.0, (2, 2))
        turn = rng.uniform(0, 2 * np.pi)
        camera = Camera.from_fov(WIDTH, HEIGHT, 50.0).look_at(
            [*at, 3.0], [*(0.4 * towards), 0.0], [np.cos(turn), np.sin(turn), 0.0]
        )
        rays = camera.unproject_image(torch.ones(HEIGHT, WIDTH).double()) - camera.position
        places = camera.position - (camera.position[2] / rays[..., 2:]) * rays
        celsius = floor_celsius(places[..., 0], places[..., 1]) + offset + shading * shading_c()
        celsius += lines_c * smeared_lines(places[..., 0])
        celsius += noise_c * torch.randn(HEIGHT, WIDTH, generator=noise)
        cameras.append(camera)
        images.append(celsius.float().numpy())
    points = np.column_stack([rng.uniform(-3.0, 3.0, (4_000, 2)), np.zeros(4_000)])
    if lines_c:
        points[::2, 0] = points[::2, 0].round()
    scene = Scene.from_arrays(cameras, celsius=images, points=points, eval_every=0)
    start = datetime(2024, 10, 30, 10, 50)
    views = []
    for number, view in enumerate(scene.train):
        taken = start + timedelta(seconds=20 * number + 300 * (number >= PAUSE))
        image = replace(view.images[THERMAL], record=PhotoRecord(taken=taken))
        views.append(replace(view, images={**view.images, THERMAL: image}))
    return replace(scene, train=tuple(views))
