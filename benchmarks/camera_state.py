"""How well a training finds what a thermal camera did: `python -m benchmarks.camera_state RUN...`

For runs of scenes of ``mrgs synth --camera``: compares the learned offsets of the photos and the
learned shading with ``truth/camera``, and the rendered temperatures of the held-out views with the
exact ones. Photos leave one constant open, so that means are removed, and from the temperatures
their median error: that of ``mrgs eval`` contains the constant. Prints two tables.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from mrgs.evaluation.evaluate import Truth
from mrgs.evaluation.metrics import mean_absolute_error_after_offset
from mrgs.runs.open import Run, open_gaussians
from mrgs.scene import THERMAL


class Agreement(NamedTuple):
    """Standard deviations of what was done, and of what was learned minus it, °C."""

    done_c: float
    error_c: float


def agreement(done: Float[np.ndarray, "*shape"], learned: Float[np.ndarray, "*shape"]) -> Agreement:
    """Of two arrays that are known up to a constant."""
    return Agreement(float(np.std(done)), float(np.std(learned - done)))


class HeldOut(NamedTuple):
    """Errors of held-out views against the exact temperatures, °C.

    Attributes:
        constant_c: median of what the model shows above them.
        model_c: mean absolute error of the model without this constant.
        camera_c: that of the camera's photos, each without its own median error.
    """

    constant_c: float
    model_c: float
    camera_c: float


def held_out(run: Run) -> HeldOut:
    """A run's errors in its held-out views."""
    scene = run.load_scene()
    truth = Truth.of(scene)
    assert truth is not None
    assert scene.temperature is not None
    rendered, exact, camera_c = [], [], []
    for view in scene.eval:
        shown = run.render_view(view)[THERMAL].image[..., 0].detach().cpu()
        true = truth.read("temperature", view.name, (shown.shape[0], shown.shape[1]))
        assert isinstance(true, torch.Tensor), true
        photo = view.images[THERMAL].load().values[..., 0]
        rendered.append(scene.temperature.to_celsius(shown))
        exact.append(true)
        camera_c.append(mean_absolute_error_after_offset(scene.temperature.to_celsius(photo), true))
    model = torch.stack(rendered), torch.stack(exact)
    constant_c = float(np.median((model[0] - model[1]).numpy()))
    return HeldOut(constant_c, mean_absolute_error_after_offset(*model), float(np.mean(camera_c)))


def camera_state(run: Run) -> dict[str, Agreement]:
    """A run's agreement, by what it learned of the camera."""
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
    runs = {name: open_gaussians(Path(name)) for name in sys.argv[1:]}
    print("| run | | done, standard deviation | error, standard deviation |")
    print("|---|---|---:|---:|")
    for name, run in runs.items():
        for what, (done_c, error_c) in camera_state(run).items():
            print(f"| {name} | {what} | {done_c:.2f} °C | {error_c:.2f} °C |")
    print("\n| run | constant | error without it | the camera's, each photo without its own |")
    print("|---|---:|---:|---:|")
    for name, run in runs.items():
        constant_c, model_c, camera_c = held_out(run)
        print(f"| {name} | {constant_c:+.2f} °C | {model_c:.3f} °C | {camera_c:.3f} °C |")


if __name__ == "__main__":
    main()
