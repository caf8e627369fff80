"""Whether one place reads the same everywhere: `python -m benchmarks.one_place RUN...`

Picks places at random in the held-out views of a run and compares what is said of each: a spot's
temperature, ``temperature_at``, the renderings of the training views that see it, pictures from
the held-out view's place as it is and turned towards the place and the viewer's cursor over them,
the same as the exported page draws them, the thermal photos that see it, and in scenes of
``mrgs synth`` the exact temperature. Prints how far each is from the spot's, as a share of its ±.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from benchmarks.interval_coverage import BORDER_PX, ExactView
from mrgs.errors import ConfigError
from mrgs.evaluation.evaluate import Truth
from mrgs.marks import Mark, open_marks
from mrgs.marks.run_marks import MarkPicker
from mrgs.marks.surface import seen_depth, thermal_values
from mrgs.runs.baked import bake
from mrgs.runs.open import load_run
from mrgs.scene import THERMAL, Camera, Rendering
from mrgs.scene.depth_map import SURFACE_DEPTH

PLACES = 100

Celsius = Float[np.ndarray, "h w"]


def compared(path: Path, seed: int, places: int = PLACES) -> list[dict[str, float]]:
    """What is said of some places of a run, °C, by who says it; their ±, K, as "±"."""
    run = load_run(path)
    scene, scale = run.load_scene(), run.temperature
    assert scale is not None, path
    marks, generator = open_marks(run, scene), np.random.default_rng(seed)
    views = [view for view in scene.train if THERMAL in view.images]
    cameras = [view.images[THERMAL].camera for view in views]
    picker = MarkPicker(marks.meter, scene)
    regions = marks.meter.regions(marks.marks)
    baked = bake(run.model, cameras, scale)

    def celsius(rendering: Rendering) -> Celsius:
        return scale.to_celsius(thermal_values(rendering))

    shown = []
    for view, camera in zip(views, cameras, strict=True):
        rendering = run.render({THERMAL: camera})
        photo = scale.to_celsius(view.images[THERMAL].load().values[..., 0]).numpy()
        shown.append((camera, seen_depth(rendering), celsius(rendering), photo))
    found: list[dict[str, float]] = []
    for _ in range(20 * places):
        view = scene.eval[generator.integers(len(scene.eval))]
        camera = view.images[THERMAL].camera
        border = int(BORDER_PX)
        x, y = generator.integers(border, [camera.width - border, camera.height - border])
        try:
            mark = marks.spot(camera, (x + 0.5, y + 0.5))
        except ConfigError:
            continue
        marks.remove(mark.name)
        reading = marks.meter.read(mark)
        if reading.problem or reading.uncertainty is None:
            continue
        place = np.array(mark.points)
        said = {"spot": reading.mean, "±": reading.uncertainty.total}
        said["temperature_at"] = float(run.temperature_at(place.astype(np.float32))[0])
        pixel = y, x
        turned, middle = _turned(camera, place[0])
        for name, eye, (row, column) in (
            ("picture", camera, pixel),
            ("picture, turned", turned, middle),
        ):
            rendering = run.render({THERMAL: eye})
            said[name] = celsius(rendering)[row, column]
            depth = seen_depth(rendering)
            said[f"cursor, {name}"] = picker.temperature(eye, depth, (column, row), regions)
        said["page"] = celsius(baked.render({THERMAL: camera}))[pixel]
        said["page, turned"] = celsius(baked.render({THERMAL: turned}))[middle]
        said |= _of_photos(shown, place)
        if Truth.of(scene) is not None:
            said["exact"] = _exact(ExactView.of(scene, view), mark, pixel)
        found.append(said)
        if len(found) == places:
            break
    return found


def _turned(camera: Camera, place: Float[np.ndarray, "3"]) -> tuple[Camera, tuple[int, int]]:
    """The camera turned towards a place, and row and column of the pixel whose centre shows it."""
    row, column = camera.height // 2, camera.width // 2
    K = camera.K.clone()
    K[0, 2], K[1, 2] = column + 0.5, row + 0.5
    return replace(camera, K=K).look_at(camera.position, place), (row, column)


def _of_photos(
    shown: list[tuple[Camera, Celsius, Celsius, Celsius]], place: Float[np.ndarray, "1 3"]
) -> dict[str, float]:
    """The means over the training views that see a place: of their renderings, and photos."""
    values = []
    for camera, depth, rendered, photo in shown:
        pixel, z = camera.project(torch.from_numpy(place))
        if camera.contains(pixel)[0]:
            column, row = pixel[0].long().tolist()
            if abs(depth[row, column] - float(z[0])) < SURFACE_DEPTH * float(z[0]):
                values.append((rendered[row, column], photo[row, column]))
    names = ("renderings", "photos")
    return dict(zip(names, np.mean(values, axis=0).tolist(), strict=True)) if values else {}


def _exact(view: ExactView, mark: Mark, pixel: tuple[int, int]) -> float:
    """Mean exact temperature of a spot's disc."""
    radius = max(mark.radius, 0.5 * view.depth[pixel] / float(view.camera.K[0, 0]))
    away = np.linalg.norm(view.points - view.points[pixel], axis=2)
    return float(view.celsius[away <= radius].mean())


def main() -> None:
    """The command line."""
    print("| run | compared with the spot | places | ≤ 1/3 of ± | ≤ ± | median, K | 90 %, K |")
    print("|---|---|---:|---:|---:|---:|---:|")
    for number, path in enumerate(map(Path, sys.argv[1:])):
        found = compared(path, number)
        for name in dict.fromkeys(name for said in found for name in said):
            rows = [said for said in found if np.isfinite(said.get(name, np.nan))]
            away = np.array([abs(said[name] - said["spot"]) for said in rows])
            share = away / np.array([said["±"] for said in rows])
            if name not in ("spot", "±"):
                held = (f"{100 * np.mean(share <= limit):.0f} %" for limit in (1 / 3, 1))
                tail = f"{np.median(away):.3f} | {np.quantile(away, 0.9):.3f}"
                print(f"| {path.name} | {name} | {len(rows)} | {' | '.join(held)} | {tail} |")


if __name__ == "__main__":
    main()
