"""The scene of all trainings: a wall that photos show from before it, written to disk.

Photos of one kind are one file under many names, so that thousands of them cost nothing.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from benchmarks.growth.plan import Case
from mrgs.data.ply import write_points
from mrgs.data.transforms import (
    BOUNDS,
    POINTS,
    TRANSFORMS,
    frame_json,
    write_bounds,
    write_transforms,
)
from mrgs.scene import THERMAL
from mrgs.scene.lens import Lens

HALF_WIDTH, HALF_HEIGHT, DEPTH = 4.0, 3.0, 0.1
"""Of the wall, in metres; its points lie within this depth."""

DISTANCE = 6.0
"""Of the cameras from the wall, which fills their images."""


def write_wall(folder: Path, case: Case) -> Path:
    """Write the scene of a case; returns its folder."""
    generator = torch.Generator().manual_seed(0)
    width, height = case.size
    lens = Lens(width, height, 0.9 * width, 0.9 * width, width / 2, height / 2)
    frames, names = [], []
    for number in range(case.photos):
        name = f"{number:05d}"
        names.append(f"images/{name}.jpg")
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, 3] = torch.rand(3, generator=generator, dtype=torch.float64) - 0.5
        viewmat[2, 3] += DISTANCE
        frames.append(frame_json(viewmat, names[-1], {THERMAL: f"thermal/{name}.png"}))
    _write_photos(folder / "images", "jpg", case, channels=3)
    _write_photos(folder / "thermal", "png", case, channels=1)
    write_transforms(folder / TRANSFORMS, frames, lens=lens, points=POINTS, split=(names, []))
    write_bounds(folder / BOUNDS, 10.0, 40.0)
    half = torch.tensor([HALF_WIDTH, HALF_HEIGHT, DEPTH])
    positions = half * (2 * torch.rand(case.gaussians, 3, generator=generator) - 1)
    colors = torch.randint(256, (case.gaussians, 3), generator=generator, dtype=torch.uint8)
    write_points(folder / POINTS, positions.numpy(), colors.numpy())
    return folder


def _write_photos(folder: Path, suffix: str, case: Case, channels: int) -> None:
    """One photo, linked as often as there are views."""
    folder.mkdir(parents=True)
    first = folder / f"{0:05d}.{suffix}"
    Image.fromarray(_picture(case.size, channels)).save(first)
    for number in range(1, case.photos):
        os.link(first, folder / f"{number:05d}.{suffix}")


def _picture(size: tuple[int, int], channels: int) -> UInt8[np.ndarray, "h w *c"]:
    """Smooth waves, of another length in each channel."""
    x, y = np.meshgrid(*(np.linspace(0, 6 * np.pi, count, dtype=np.float32) for count in size))
    waves = [np.sin((1 + k) * x) * np.cos((2 + k) * y) for k in range(channels)]
    levels = np.rint(127.5 * (1 + np.stack(waves, axis=-1))).astype(np.uint8)
    return levels if channels > 1 else levels[..., 0]
