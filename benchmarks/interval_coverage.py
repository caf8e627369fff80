"""How often the ± of marks holds the truth: `python -m benchmarks.interval_coverage RUN...`

Puts spots and boxes at random places of the held-out views of scenes of ``mrgs synth``, whose
temperatures are known, and measures them as ``mrgs measure`` does. The marks are removed again.
Prints a table.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool
from PIL import Image

from mrgs.errors import ConfigError
from mrgs.marks import open_marks
from mrgs.marks.mark import Mark
from mrgs.marks.run_marks import RunMarks
from mrgs.runs.open import load_run
from mrgs.scene import THERMAL, Scene, View

SPOTS, BOXES, TRIES = 12, 10, 120
"""Marks of a view, and how many places are tried for them."""

BOX_PX = (5.0, 30.0)
"""Sides of a box."""

FLATNESS = 0.03
"""A box lies on one plane: its depths are off by no larger share."""

FARTHEST = 1e3
"""Deeper pixels show the sky, scene units."""


class Found(NamedTuple):
    """A mark that was measured.

    Attributes:
        kind: "spot" or "box".
        off: its temperature minus the exact one, °C.
        around: its ±, K.
    """

    kind: str
    off: float
    around: float


class Truth(NamedTuple):
    """What a view shows exactly: °C and z-depth of each pixel."""

    temperature: np.ndarray
    depth: np.ndarray

    @classmethod
    def of(cls, scene: Scene, view: View) -> Truth:
        """That of a held-out view."""
        folder = Path(scene.path) / "truth"
        names = ("temperature", "depth")
        images = (Image.open(folder / name / f"{view.name}.tiff") for name in names)
        return cls(*(np.asarray(image, np.float64) for image in images))

    def is_flat(self, part: tuple[slice, slice]) -> bool:
        """Whether a part of the image shows one plane: there 1 / depth is linear in the pixel."""
        depth = self.depth[part]
        if not (np.isfinite(depth).all() and depth.min() > 0 and depth.max() < FARTHEST):
            return False
        y, x = np.mgrid[: depth.shape[0], : depth.shape[1]]
        linear = np.stack([x.ravel(), y.ravel(), np.ones(depth.size)], axis=1)
        inverse = 1 / depth.ravel()
        rest = inverse - linear @ np.linalg.lstsq(linear, inverse, rcond=None)[0]
        return bool(np.abs(rest / inverse).max() <= FLATNESS)


def measured(marks: RunMarks, scene: Scene, seed: int) -> Iterator[Found]:
    """Marks of the held-out views whose ± is known."""
    generator = np.random.default_rng(seed)
    for view in scene.eval:
        truth = Truth.of(scene, view)
        for place, count in ((_spot, SPOTS), (_box, BOXES)):
            made = 0
            for _ in range(TRIES):
                if made == count:
                    break
                placed = place(marks, view, truth, generator)
                if placed is None:
                    continue
                mark, pixels = placed
                made += 1
                reading = marks.meter.read(mark)
                marks.remove(mark.name)
                if not reading.problem and reading.uncertainty and reading.mean is not None:
                    off = reading.mean - float(truth.temperature[pixels].mean())
                    yield Found(mark.kind, off, reading.uncertainty.total)


def _spot(
    marks: RunMarks, view: View, truth: Truth, generator: np.random.Generator
) -> tuple[Mark, Bool[np.ndarray, "h w"]] | None:
    """A spot at a random pixel, and the pixels that show it; None where none can be."""
    camera = view.images[THERMAL].camera
    x, y = generator.uniform(3, camera.width - 3), generator.uniform(3, camera.height - 3)
    depth = truth.depth[int(y), int(x)]
    if not 0 < depth < FARTHEST:
        return None
    try:
        mark = marks.spot(camera, (x, y))
    except ConfigError:
        return None
    points = camera.unproject_image(torch.from_numpy(truth.depth)).numpy()
    radius = max(mark.radius or 0.0, 0.5 * depth / float(camera.K[0, 0]))
    return mark, np.linalg.norm(points - points[int(y), int(x)], axis=2) <= radius


def _box(
    marks: RunMarks, view: View, truth: Truth, generator: np.random.Generator
) -> tuple[Mark, Bool[np.ndarray, "h w"]] | None:
    """A box on a plane, and the pixels in it; None where none can be."""
    camera = view.images[THERMAL].camera
    width, height = generator.uniform(*BOX_PX, 2)
    x = generator.uniform(1, camera.width - width - 1)
    y = generator.uniform(1, camera.height - height - 1)
    part = slice(int(y), int(y + height) + 1), slice(int(x), int(x + width) + 1)
    if not truth.is_flat(part):
        return None
    try:
        mark = marks.box(camera, (x, y), (x + width, y + height))
    except ConfigError:
        return None
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    within = (column > x) & (column < x + width) & (row > y) & (row < y + height)
    return mark, within


def main() -> None:
    """The command line."""
    print("| run | spots | held | boxes | held | all held | median ±, K | median error, K |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|")
    everything: list[Found] = []
    for number, path in enumerate(map(Path, sys.argv[1:])):
        run = load_run(path)
        scene = run.load_scene()
        marks = open_marks(run, scene)
        found = list(measured(marks, scene, seed=number))
        _print(path.name, found)
        everything += found
    _print("together", everything)


def _print(name: str, found: list[Found]) -> None:
    def held(chosen: list[Found]) -> str:
        inside = [abs(each.off) <= each.around for each in chosen]
        return f"{100 * np.mean(inside):.1f} %" if inside else "–"

    spots = [each for each in found if each.kind == "spot"]
    boxes = [each for each in found if each.kind == "box"]
    around, off = (np.median([getattr(f, n) for f in found]) for n in ("around", "off"))
    print(
        f"| {name} | {len(spots)} | {held(spots)} | {len(boxes)} | {held(boxes)} | {held(found)} "
        f"| {around:.2f} | {off:+.2f} |",
        flush=True,
    )


if __name__ == "__main__":
    main()
