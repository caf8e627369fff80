"""Whether photos of a later pass agree with a model within its ±: `python -m benchmarks.repeats`

The held-out views of the run are the later pass, none of which was trained on. The camera drifts
and shades in them as it did then, not as in the photos that were trained: what it did is found from
where the photos of the later pass overlap with each other, by the same fit as before a training,
without the model. Spots are put at random places of these views and measured as ``mrgs measure``
does; what the corrected photos show there, less the change by the camera's blur, is compared with
that. Photos leave one constant open, which is that of the pass.

    python -m benchmarks.repeats split SCENE FOLDER --first 18
    mrgs train FOLDER --preset fast --resolution 480 --output RUN
    python -m benchmarks.repeats measure RUN
"""

from __future__ import annotations

import argparse
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import uniform_filter

from benchmarks.interval_coverage import BORDER_PX
from mrgs.errors import ConfigError
from mrgs.marks import Mark, open_marks
from mrgs.marks.run_marks import MarkPicker
from mrgs.marks.surface import disc_mask, seen_depth
from mrgs.method.camera_model.image_model import ImageModel
from mrgs.method.start.overlap import find_from_overlap, without_camera
from mrgs.runs.open import Run, open_gaussians
from mrgs.scene import THERMAL, Blend, Rendering, Scene, View
from mrgs.scene.capture import Capture
from mrgs.scene.depth_map import SURFACE_DEPTH, DepthMap, carry_over

FEWEST_PHOTOS = 3
"""The mean of fewer photos is little better than one."""


class Repeat(NamedTuple):
    """A spot in a photo of the later pass.

    Attributes:
        photo: number of the photo.
        as_taken: what it shows minus the mark's mean, K.
        corrected: the same with the pass's drift and shading corrected.
        together: of all photos of the pass that see the place, corrected; NaN for few of them.
        own, total: the ± of the mark, without and with what all marks share, K.
    """

    photo: int
    as_taken: float
    corrected: float
    together: float
    own: float
    total: float


def corrected_pass(run: Run, scene: Scene) -> Scene:
    """The held-out views as a scene of their own, their photos without offsets and shading."""
    alone = replace(scene, train=scene.eval, eval=())
    camera = ImageModel(run.config.image_model, Capture.of(alone))
    find_from_overlap(alone, camera, run.config.image_model)
    return without_camera(alone, camera)


def repeats(run: Run, spots: int, seed: int) -> list[Repeat]:
    """Random spots of all photos of the later pass."""
    scene = run.load_scene()
    marks, generator = open_marks(run, scene), np.random.default_rng(seed)
    picker = MarkPicker(marks.meter, scene)
    taken, corrected = (
        [_without_blur(run, view) for view in views]
        for views in (scene.eval, corrected_pass(run, scene).train)
    )
    found: list[Repeat] = []
    for number, view in enumerate(scene.eval):
        camera = view.images[THERMAL].camera
        for _ in range(spots):
            x = generator.uniform(BORDER_PX, camera.width - BORDER_PX)
            y = generator.uniform(BORDER_PX, camera.height - BORDER_PX)
            try:
                place = picker.pick("spot", camera, [(x, y)])
            except ConfigError:
                continue
            reading = marks.meter.read(Mark("?", "spot", **place))
            if reading.problem or reading.uncertainty is None:
                continue
            points = np.array(place["points"], np.float32)
            disc = disc_mask(camera, taken[number].depth, points[0].astype(float), place["radius"])
            disc[int(y), int(x)] = True
            alone = [float(np.nanmean(each[number].image[disc])) for each in (taken, corrected)]
            seen = sum(len(each.shown(points).rows) for each in corrected)
            mean = carry_over(corrected, points, 0.0, SURFACE_DEPTH)[0][0, 0]
            together = float(mean) if seen >= FEWEST_PHOTOS else np.nan
            off = [each - reading.mean for each in (*alone, together)]
            around = reading.uncertainty
            found.append(Repeat(number, *off, around.own, around.total))
    return found


def _without_blur(run: Run, view: View) -> DepthMap:
    """The temperatures of a photo less the change by the camera's blur, °C, means over 3×3 pixels,
    with the depths of the model."""
    scale, camera = run.temperature, view.images[THERMAL].camera
    assert scale is not None
    rendering = run.render({THERMAL: camera})
    sharp = rendering[THERMAL].image
    nothing = Rendering({THERMAL: Blend.of_image(torch.zeros_like(sharp))})
    added = run.camera_response(nothing, camera)[THERMAL].image
    blurring = run.camera_response(rendering, camera)[THERMAL].image - added - sharp
    values = scale.to_celsius(view.images[THERMAL].load().values - blurring)[..., 0].numpy()
    depth = seen_depth(rendering).astype(np.float32)
    return DepthMap(camera, depth, uniform_filter(values, 3)[..., None])


def split(scene: Path, folder: Path, first: int, swapped: bool) -> None:
    """A copy of a scene of ``mrgs prepare`` whose first views, by name, are trained, and the later
    ones held out; swapped, the other way round."""
    shutil.copytree(scene, folder)
    path = folder / "transforms.json"
    facts = json.loads(path.read_text(encoding="utf-8"))
    names = sorted(frame["file_path"] for frame in facts["frames"])
    parts = (names[first:], names[:first]) if swapped else (names[:first], names[first:])
    facts["train_filenames"], facts["test_filenames"] = parts
    facts["val_filenames"] = parts[1]
    path.write_text(json.dumps(facts), encoding="utf-8")


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(required=True, dest="command")
    halves = commands.add_parser("split")
    halves.add_argument("scene", type=Path)
    halves.add_argument("folder", type=Path)
    halves.add_argument("--first", type=int, required=True)
    halves.add_argument("--swapped", action="store_true")
    measure = commands.add_parser("measure")
    measure.add_argument("run", type=Path)
    measure.add_argument("--spots", type=int, default=25)
    measure.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if options.command == "split":
        split(options.scene, options.folder, options.first, options.swapped)
    else:
        _print(options)


def _print(options: argparse.Namespace) -> None:
    """The table of a run."""
    found = repeats(open_gaussians(options.run), options.spots, options.seed)
    photo, taken, corrected, together, own, total = map(np.array, zip(*found, strict=True))
    by_photo = np.array([np.median(taken[photo == each]) for each in photo])
    print(f"± {np.nanmedian(own):.2f} K alone, {np.nanmedian(total):.2f} K in all (medians)")
    print("| of the photos | spots | median difference, K | within ± alone | within ± |")
    print("|---|---:|---:|---:|---:|")
    for name, off in (
        ("each as taken, less one constant", taken - np.nanmedian(taken)),
        ("each as taken, less its own constant", taken - by_photo),
        ("each less drift and shading, less one constant", corrected - np.nanmedian(corrected)),
        ("the mean less drift and shading, less one constant", together - np.nanmedian(together)),
    ):
        known = np.isfinite(off) & np.isfinite(own)
        away = np.abs(off[known])
        held = (f"{100 * np.mean(away <= width[known]):.1f} %" for width in (own, total))
        print(f"| {name} | {known.sum()} | {np.median(away):.3f} | {' | '.join(held)} |")


if __name__ == "__main__":
    main()
