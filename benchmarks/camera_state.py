"""How well a training finds what a thermal camera did: `python -m benchmarks.camera_state RUN...`

For runs of scenes of ``mrgs synth --camera``: compares the learned offsets of the photos and the
learned shading with ``truth/camera``. Both are known up to a constant, so that means are removed.
Prints a table.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from PIL import Image

from mrgs.runs.open import open_gaussians
from mrgs.scene import THERMAL


class Agreement(NamedTuple):
    """Standard deviations of what was done, and of what was learned minus it, °C."""

    done_c: float
    error_c: float


def agreement(done: Float[np.ndarray, "*shape"], learned: Float[np.ndarray, "*shape"]) -> Agreement:
    """Of two arrays that are known up to a constant."""
    return Agreement(float(np.std(done)), float(np.std(learned - done)))


def camera_state(path: Path) -> dict[str, Agreement]:
    """A run's agreement, by what it learned of the camera."""
    run = open_gaussians(path)
    scene = run.load_scene()
    assert scene.temperature is not None
    span_c, folder = scene.temperature.span_c, Path(scene.path) / "truth/camera"
    photos = json.loads((folder / "camera.json").read_text(encoding="utf-8"))["photos"]
    drift, shading = run.image_model.thermal_drift, run.image_model.thermal_shading
    found = {}
    if drift is not None:
        names = [view.name for view in scene.train if THERMAL in view.images]
        done_c = np.array([photos[name]["drift_c"] for name in names])
        found["drift"] = agreement(done_c, span_c * drift.offsets().double().numpy(force=True))
    if shading is not None:
        with Image.open(folder / "shading.tiff") as image:
            done_c = np.asarray(image, dtype=np.float64)
        learned = shading(*done_c.shape)[..., 0].double().numpy(force=True)
        found["shading"] = agreement(done_c, span_c * learned)
    return found


def main() -> None:
    """The command line."""
    print("| run | | done, standard deviation | error, standard deviation |")
    print("|---|---|---:|---:|")
    for name in sys.argv[1:]:
        for what, (done_c, error_c) in camera_state(Path(name)).items():
            print(f"| {name} | {what} | {done_c:.2f} °C | {error_c:.2f} °C |")


if __name__ == "__main__":
    main()
