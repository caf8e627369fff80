"""How often the ± of marks holds the truth: `python -m benchmarks.interval_coverage RUN...`

Puts spots and boxes at random places of the held-out views of scenes of ``mrgs synth``, whose
temperatures are known, and spots on the hottest and the coldest places ("peaks"), as the report
does. All are measured as ``mrgs measure`` does; none is kept. Prints a table.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float64

from mrgs.errors import ConfigError
from mrgs.evaluation.evaluate import Truth
from mrgs.marks import open_marks
from mrgs.marks.mark import Mark, places_of
from mrgs.marks.run_marks import RunMarks, spot_radius
from mrgs.report.anomalies import find_spots
from mrgs.runs.open import load_run
from mrgs.scene import THERMAL, Camera, Scene, View
from mrgs.scene.depth_map import SURFACE_DEPTH

PEAKS = 6
"""Hottest places of a scene, and as many coldest."""

SPOTS, BOXES, TRIES = 12, 10, 120
"""Marks of a view, and how many places are tried for them."""

BOX_PX = (5.0, 30.0)
"""Sides of a box."""

BORDER_PX = 3.0
"""A spot is no nearer to the border of a view."""

FLATNESS = 0.03
"""A box lies on one plane: its depths are off by no larger share."""

FARTHEST = 1e3
"""Deeper pixels show the sky, scene units."""

KINDS = ("spot", "box", "peak")


class Found(NamedTuple):
    """A mark that was measured.

    Attributes:
        kind: of ``KINDS``.
        off: its temperature minus the exact one, °C.
        around: its ±, K.
    """

    kind: str
    off: float
    around: float


class ExactView(NamedTuple):
    """What a held-out view shows exactly.

    Attributes:
        camera: of the pixels.
        celsius: temperature, [H, W].
        depth: z-depth, [H, W].
        points: world coordinates, [H, W, 3].
    """

    camera: Camera
    celsius: Float64[np.ndarray, "h w"]
    depth: Float64[np.ndarray, "h w"]
    points: Float64[np.ndarray, "h w 3"]

    @classmethod
    def of(cls, scene: Scene, view: View) -> ExactView:
        """That of a view."""
        truth, camera = Truth.of(scene), view.images[THERMAL].camera
        assert truth is not None, scene.path
        images = []
        for kind in ("temperature", "depth"):
            found = truth.read(kind, view.name, (camera.height, camera.width))
            assert isinstance(found, torch.Tensor), found
            images.append(found.double())
        points = camera.unproject_image(images[1]).numpy()
        return cls(camera, images[0].numpy(), images[1].numpy(), points)

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

    def disc(self, mark: Mark) -> Bool[np.ndarray, "h w"]:
        """The pixels that show a spot's disc; none where it is not seen, or is near the border."""
        pixels, z = self.camera.project(torch.tensor(mark.points, dtype=torch.float64))
        x, y = pixels[0].tolist()
        none = np.zeros(self.depth.shape, bool)
        height, width = none.shape
        if not (BORDER_PX <= x < width - BORDER_PX and BORDER_PX <= y < height - BORDER_PX):
            return none
        depth = self.depth[int(y), int(x)]
        if not (0 < depth < FARTHEST and abs(depth - float(z[0])) <= SURFACE_DEPTH * depth):
            return none
        radius = max(mark.radius or 0.0, 0.5 * depth / float(self.camera.K[0, 0]))
        away = np.linalg.norm(self.points - self.points[int(y), int(x)], axis=2)
        inside: Bool[np.ndarray, "h w"] = away <= radius
        return inside


Placed = tuple[Mark, Bool[np.ndarray, "h w"]]
"""A mark, and the pixels of a view that show it."""


def measured(marks: RunMarks, scene: Scene, seed: int) -> Iterator[Found]:
    """The marks whose ± is known."""
    generator = np.random.default_rng(seed)
    views = [ExactView.of(scene, view) for view in scene.eval]
    for view in views:
        for place, count in ((_spot, SPOTS), (_box, BOXES)):
            tried = (place(marks, view, generator) for _ in range(TRIES))
            placed = (each for each in tried if each is not None)
            for _, (mark, pixels) in zip(range(count), placed, strict=False):
                marks.remove(mark.name)
                yield from _read(marks, mark, mark.kind, view.celsius[pixels])
    for mark in _peaks(scene, marks):
        shown = [view.celsius[pixels] for view in views if (pixels := view.disc(mark)).any()]
        if shown:
            yield from _read(marks, mark, "peak", max(shown, key=len))


def _read(
    marks: RunMarks, mark: Mark, kind: str, exact: Float64[np.ndarray, " n"]
) -> Iterator[Found]:
    reading = marks.meter.read(mark)
    if not reading.problem and reading.uncertainty is not None:
        yield Found(kind, reading.mean - float(exact.mean()), reading.uncertainty.total)


def _spot(marks: RunMarks, view: ExactView, generator: np.random.Generator) -> Placed | None:
    """A spot at a random pixel; None where none can be."""
    camera = view.camera
    x = generator.uniform(BORDER_PX, camera.width - BORDER_PX)
    y = generator.uniform(BORDER_PX, camera.height - BORDER_PX)
    depth = view.depth[int(y), int(x)]
    if not 0 < depth < FARTHEST:
        return None
    try:
        mark = marks.spot(camera, (x, y))
    except ConfigError:
        return None
    radius = max(mark.radius or 0.0, 0.5 * depth / float(camera.K[0, 0]))
    away = np.linalg.norm(view.points - view.points[int(y), int(x)], axis=2)
    return mark, away <= radius


def _box(marks: RunMarks, view: ExactView, generator: np.random.Generator) -> Placed | None:
    """A box on a plane; None where none can be."""
    camera = view.camera
    width, height = generator.uniform(*BOX_PX, 2)
    x = generator.uniform(1, camera.width - width - 1)
    y = generator.uniform(1, camera.height - height - 1)
    part = slice(int(y), int(y + height) + 1), slice(int(x), int(x + width) + 1)
    if not view.is_flat(part):
        return None
    try:
        mark = marks.box(camera, (x, y), (x + width, y + height))
    except ConfigError:
        return None
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    within = (column > x) & (column < x + width) & (row > y) & (row < y + height)
    return mark, within


def _peaks(scene: Scene, marks: RunMarks) -> Iterator[Mark]:
    """Spots on the hottest and the coldest places, as the report measures them."""
    views = scene.views
    for spots in find_spots(views, marks.run.render, PEAKS, scene.reach, []):
        for spot in spots:
            camera = views[spot.view].images[THERMAL].camera
            place, eye = places_of([spot.position.tolist(), camera.position.tolist()])
            yield Mark("?", "spot", (place,), eye, spot_radius(place, camera, scene))


def main() -> None:
    """The command line."""
    columns = [f"{kind} | held | median ±, K" for kind in ("spots", "boxes", "peaks")]
    print(f"| run | {' | '.join(columns)} |")
    print("|---" + "|---:" * 9 + "|")
    everything: list[Found] = []
    for number, path in enumerate(map(Path, sys.argv[1:])):
        run = load_run(path)
        scene = run.load_scene()
        found = list(measured(open_marks(run, scene), scene, seed=number))
        _print(path.name, found)
        everything += found
    _print("together", everything)


def _print(name: str, found: list[Found]) -> None:
    cells = []
    for kind in KINDS:
        chosen = [each for each in found if each.kind == kind]
        inside = [abs(each.off) <= each.around for each in chosen]
        held = f"{100 * np.mean(inside):.1f} %" if inside else "–"
        width = f"{np.median([each.around for each in chosen]):.2f}" if chosen else "–"
        cells.append(f"{len(chosen)} | {held} | {width}")
    print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
