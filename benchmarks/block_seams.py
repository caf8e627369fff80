"""Whether blocks leave seams: `python -m benchmarks.block_seams UNSPLIT BLOCKS...`

Compares runs of ``mrgs train --blocks`` with one of the same scene that was not split, on its
held-out views: in a band along the cuts, and elsewhere. The scene is one of ``mrgs synth``, whose
depths and temperatures are known. Prints a table.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from mrgs.blocks.plan import BlockPlan, read_plan
from mrgs.evaluation.evaluate import Truth
from mrgs.runs.open import Run, load_run
from mrgs.scene import RGB, THERMAL, Scene, View

BAND = 1.0
"""Half the width of the band along the cuts, scene units."""


class Score(NamedTuple):
    """PSNR of the images in dB, and mean absolute error of the temperatures against the exact ones
    in °C."""

    rgb_db: float
    thermal_db: float
    error_c: float


def exact(view: View, scene: Scene, kind: str) -> Float32[Tensor, "h w"]:
    """What a held-out view shows exactly: its ``depth`` or its ``temperature``."""
    truth, camera = Truth.of(scene), view.camera
    found = None if truth is None else truth.read(kind, view.name, (camera.height, camera.width))
    assert isinstance(found, Tensor), found
    return found


def near_cuts(view: View, scene: Scene, plan: BlockPlan) -> Bool[np.ndarray, "h w"]:
    """Which pixels of a view show a place in the band along a cut."""
    points = view.camera.unproject_image(exact(view, scene, "depth").double())
    places = plan.plane.coordinates(points)
    blocks = sum(
        cell.region.grown(BAND).contains(places).int()
        - cell.region.grown(-BAND).contains(places).int()
        for cell in plan.cells
    )
    assert isinstance(blocks, torch.Tensor)
    return (blocks > 0).numpy()


def scores(run: Run, scene: Scene, plan: BlockPlan) -> dict[str, Score]:
    """Scores of a run near the cuts and elsewhere, over all pixels of the held-out views."""
    squares: dict[str, list[list[np.ndarray]]] = {"band": [[], [], []], "elsewhere": [[], [], []]}
    for view in scene.eval:
        rendering = run.camera_response(run.render_view(view), view.camera)
        ideal = run.temperatures_c(run.render_view(view), min_alpha=0).numpy()
        band = near_cuts(view, scene, plan)
        measured = (
            (rendering[RGB].image - view.images[RGB].load().values).square().mean(dim=2).numpy(),
            (rendering[THERMAL].image - view.images[THERMAL].load().values)[..., 0]
            .square()
            .numpy(),
            np.abs(ideal - exact(view, scene, "temperature").numpy()),
        )
        for where, mask in (("band", band), ("elsewhere", ~band)):
            for kept, values in zip(squares[where], measured, strict=True):
                kept.append(values[mask])
    found = {}
    for where, parts in squares.items():
        rgb, thermal, error = (float(np.concatenate(each).mean()) for each in parts)
        found[where] = Score(-10 * np.log10(rgb), -10 * np.log10(thermal), error)
    return found


def main() -> None:
    """The command line."""
    whole, *split = map(Path, sys.argv[1:])
    reference = load_run(whole)
    scene = reference.load_scene()
    print("| | where | RGB | thermal | error against the exact °C | Gaussians |")
    print("|---|---|---|---|---|---|")
    for path in split:
        plan = read_plan(path / "blocks/plan.json")
        assert plan is not None, path
        for name, run in ((whole, reference), (path, load_run(path))):
            for where, score in scores(run, scene, plan).items():
                print(
                    f"| {name} | {where} | {score.rgb_db:.2f} dB | {score.thermal_db:.2f} dB | "
                    f"{score.error_c:.3f} °C | {run.gaussian_count:,} |"
                )


if __name__ == "__main__":
    main()
