"""Which depth L_boltz prefers: `python -m benchmarks.boltzmann_depth SCENE...`

Gives L_boltz a perfect thermal image and several depths, for each reading of the paper, on scenes
whose exact depths and temperatures are known (``mrgs synth``). Prints a table for each scene.

As published, t_GT is in kelvin and what radiates has the same area everywhere. What a pixel sees
grows with the square of its depth.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from itertools import product
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from mrgs.data import load_scene
from mrgs.method.losses.radiation import boltzmann_loss, normalise_radiation, thermal_radiation
from mrgs.scene import THERMAL, Scene

FLOATER_PX = 8


def floaters(
    depth: Float[Tensor, "h w"], rows: int, columns: int, factor: float
) -> Float[Tensor, "h w"]:
    """A grid of squares of 8×8 pixels in front of the surfaces, at a factor of their depth."""
    height, width = depth.shape
    changed = depth.clone()
    for row, column in product(range(rows), range(columns)):
        y = round((row + 0.5) * height / rows) - FLOATER_PX // 2
        x = round((column + 0.5) * width / columns) - FLOATER_PX // 2
        changed[y : y + FLOATER_PX, x : x + FLOATER_PX] *= factor
    return changed


DEPTHS: Mapping[str, Callable[[Tensor], Tensor]] = {
    "exact": lambda depth: depth,
    "constant": lambda depth: torch.full_like(depth, depth.mean().item()),
    "halfway to constant": lambda depth: depth.mean() + 0.5 * (depth - depth.mean()),
    "one floater": lambda depth: floaters(depth, 1, 1, 0.3),
    "20 floaters": lambda depth: floaters(depth, 4, 5, 0.5),
    "twice as deep": lambda depth: 2 * depth,
}


def losses(scene: Scene, folder: Path, temperatures: str, area: str) -> dict[str, float]:
    """L_boltz of each depth for one reading, u = 0, mean over the held-out views."""
    found: dict[str, list[float]] = {name: [] for name in DEPTHS}
    scale = scene.temperature
    assert scale is not None
    for view in scene.eval:
        celsius, exact = (
            torch.from_numpy(np.array(Image.open(folder / f"truth/{kind}/{view.name}.tiff")))
            for kind in ("temperature", "depth")
        )
        valid = exact > 0
        exact = torch.where(valid, exact, exact[valid].max())
        photo = view.images[THERMAL].load().values[..., 0]
        image = (celsius - scale.min_c) / scale.span_c
        for name, change in DEPTHS.items():
            radiation = thermal_radiation(
                photo,
                change(exact),
                scene.extent,
                scale if temperatures == "kelvin" else None,
            )
            if area == "pixel":
                radiation = radiation * exact.square()
            radiation = normalise_radiation(radiation, valid)
            loss = boltzmann_loss(image, radiation, torch.zeros_like(image), valid)
            found[name].append(loss.item())
    return {name: float(np.mean(values)) for name, values in found.items()}


def main() -> None:
    """Print the table of each scene named on the command line."""
    for name in sys.argv[1:]:
        folder = Path(name)
        scene = load_scene(folder)
        print(
            f"{folder.name}\n| t_GT | area | {' | '.join(DEPTHS)} |\n|{'---|' * (2 + len(DEPTHS))}"
        )
        for temperatures, area in product(("kelvin", "normalised"), ("constant", "pixel")):
            row = losses(scene, folder, temperatures, area).values()
            figures = " | ".join(f"{value:.4f}" for value in row)
            print(f"| {temperatures} | {area} | {figures} |")


if __name__ == "__main__":
    main()
