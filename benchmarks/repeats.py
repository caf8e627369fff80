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

from benchmarks.interval_coverage import BORDER_PX
from mrgs.errors import ConfigError
from mrgs.marks import open_marks
from mrgs.marks.surface import disc_mask, seen_depth
from mrgs.method.camera_model.image_model import ImageModel
from mrgs.method.start.overlap import find_from_overlap, without_camera
from mrgs.runs.open import Run, open_gaussians
from mrgs.scene import THERMAL, Blend, Rendering, Scene
from mrgs.scene.capture import Capture

TRIES = 6
"""Places that are tried for each spot."""


class Repeat(NamedTuple):
    """A spot in a photo of the later pass: the photo's number, what the photo shows as taken and
    with the pass's camera corrected, each minus the mark's mean, K; the ± of the mark, without and
    with what all marks share, K."""

    photo: int
    as_taken: float
    corrected: float
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
    scene, scale = run.load_scene(), run.temperature
    assert scale is not None
    marks, generator = open_marks(run, scene), np.random.default_rng(seed)
    found = []
    for number, (view, own) in enumerate(
        zip(scene.eval, corrected_pass(run, scene).train, strict=True)
    ):
        camera = view.images[THERMAL].camera
        rendering = run.render({THERMAL: camera})
        sharp = rendering[THERMAL].image
        nothing = Rendering({THERMAL: Blend.of_image(torch.zeros_like(sharp))})
        added = run.camera_response(nothing, camera)[THERMAL].image
        blurring = run.camera_response(rendering, camera)[THERMAL].image - added - sharp
        depth = seen_depth(rendering)
        taken, corrected = (
            scale.to_celsius(each.images[THERMAL].load().values - blurring)[..., 0].numpy()
            for each in (view, own)
        )
        for _ in range(TRIES * spots):
            x = generator.uniform(BORDER_PX, camera.width - BORDER_PX)
            y = generator.uniform(BORDER_PX, camera.height - BORDER_PX)
            try:
                mark = marks.spot(camera, (x, y))
            except ConfigError:
                continue
            marks.remove(mark.name)
            disc = disc_mask(camera, depth, np.array(mark.points[0]), mark.radius)
            disc[int(y), int(x)] = True
            reading = marks.meter.read(mark)
            if reading.problem or reading.uncertainty is None:
                continue
            around = reading.uncertainty
            first, second = (float(np.nanmean(image[disc])) for image in (taken, corrected))
            off = first - reading.mean, second - reading.mean
            found.append(Repeat(number, *off, around.own, around.total))
            if sum(each.photo == number for each in found) == spots:
                break
    return found


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
    photo, taken, corrected, own, total = map(np.array, zip(*found, strict=True))
    by_photo = np.array([np.median(taken[photo == each]) for each in photo])
    own_c = np.array([np.median(corrected[photo == each]) for each in photo])
    print(f"{len(found)} spots; ± {np.median(own):.2f} K alone, {np.median(total):.2f} K in all")
    print("| what is taken off the photos | median difference, K | within ± alone | within ± |")
    print("|---|---:|---:|---:|")
    for name, off in (
        ("the pass's constant", taken - np.median(taken)),
        ("each photo's own constant", taken - by_photo),
        ("the pass's drift and shading, its constant", corrected - np.median(corrected)),
        ("the pass's drift and shading, each photo's own", corrected - own_c),
    ):
        held = (f"{100 * np.mean(np.abs(off) <= width):.1f} %" for width in (own, total))
        print(f"| {name} | {np.median(np.abs(off)):.3f} | {' | '.join(held)} |")


if __name__ == "__main__":
    main()
