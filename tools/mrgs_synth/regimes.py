"""Harder versions of a scene: fewer views, wrong poses, noise, missing or small thermal photos.

    python -m mrgs_synth.regimes SCENE OUT --name views-8

Only what a training sees changes; the evaluation views, their photos, poses and truth stay as they
are, but for ``every-pose-2px``. The same scene, regime and seed give the same files; unchanged
images are hard links.
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from PIL import Image
from torch import Tensor

from mrgs.data.load import assign_splits, read_bounds
from mrgs.data.nerfstudio import find_transforms, read_transforms
from mrgs.data.ply import write_points
from mrgs.data.sources import ImageSource, SceneSource, ViewSource
from mrgs.data.transforms import (
    BOUNDS,
    POINTS,
    RECORD,
    TRANSFORMS,
    frame_json,
    world_json,
    write_bounds,
    write_transforms,
)
from mrgs.errors import ConfigError
from mrgs.scene import RGB, THERMAL, Modality
from mrgs.scene.lens import Lens
from mrgs.scene.rotations import matrix_from_rotvec, rigid_transform
from mrgs_synth.drift import Drift

NOISE_DB = 30.0
NEAREST = 1e-6


@dataclass(frozen=True, eq=False)
class TrainingView:
    """A training view while it is changed.

    Attributes:
        source: its images, lenses and poses.
        thermal: what is done to its thermal photo's values [h, w] or [h, w, 3] when it is written;
            None links the file.
        in_celsius: whether these become °C, in a TIFF.
    """

    source: ViewSource
    thermal: Callable[[np.ndarray], np.ndarray] | None = None
    in_celsius: bool = False

    def with_images(self, images: Mapping[Modality, ImageSource]) -> TrainingView:
        """The view with other images."""
        return replace(self, source=replace(self.source, images=images))


DRIFT_C = 0.5
LITTLE_DRIFT = Drift(ramp_c=DRIFT_C)
"""Of an uncooled camera in the hand of a person who walks around a building."""

MUCH_DRIFT = Drift(ramp_c=0.5, jump_c=0.3, pauses=1, rest_c=-4.0)
"""With a pause, after which the camera is colder and takes minutes to settle."""

Change = Callable[[Sequence[TrainingView], SceneSource, np.random.Generator], list[TrainingView]]


def make_regime(scene: Path, output: Path, name: str, seed: int = 0) -> None:
    """Write a harder version of a scene.

    Args:
        scene: a folder with ``transforms.json``.
        output: the new folder.
        name: of ``REGIMES``.
        seed: of what is chosen at random.

    Raises:
        ConfigError: the regime is not known, does not suit the scene, or ``output`` holds a scene.
        SceneError: the scene cannot be read.
    """
    if name not in REGIMES:
        raise ConfigError(f"unknown regime {name}: choose one of {', '.join(REGIMES)}")
    file = find_transforms(scene.resolve())
    if file is None:
        raise ConfigError(f"{scene} has no transforms.json: prepare the scene first")
    if (output / TRANSFORMS).exists():
        raise ConfigError(f"{output} holds a scene already: delete it, or choose another folder")
    source = read_transforms(scene.resolve(), file)
    sides = assign_splits([view.key for view in source.views], source.lists, source.notes)
    train, held_out = (
        [
            TrainingView(view)
            for view, side in zip(source.views, sides, strict=True)
            if side == wanted
        ]
        for wanted in ("train", "eval")
    )
    rng = np.random.default_rng(seed)
    changed = REGIMES[name](train, source, rng)
    if name in ALSO_HELD_OUT:
        held_out = REGIMES[name](held_out, source, rng)
    _write(output, source, changed, held_out)


def _keep_all(
    views: Sequence[TrainingView], scene: SceneSource, rng: np.random.Generator
) -> list[TrainingView]:
    del scene, rng
    return list(views)


def _fewer_views(
    count: int, views: Sequence[TrainingView], scene: SceneSource, rng: np.random.Generator
) -> list[TrainingView]:
    """Evenly chosen views, in the order of their names; the first and the last are among them."""
    del scene, rng
    if len(views) < count:
        raise ConfigError(f"there are {len(views)} training views, fewer than {count}")
    ordered = sorted(views, key=lambda view: view.source.key)
    return [ordered[i] for i in np.linspace(0, len(ordered) - 1, count).round().astype(int)]


def _wrong_poses(
    shift_px: float, views: Sequence[TrainingView], scene: SceneSource, rng: np.random.Generator
) -> list[TrainingView]:
    """Cameras turned and moved at random, so that points at the median depth are seen ``shift_px``
    pixels away on average. Both images of a view move alike."""
    if scene.points is None:
        raise ConfigError("the scene has no points, which tell how far a pose error shifts pixels")
    points = scene.points.positions.double().numpy()
    firsts = [_first(view) for view in views]
    depth = float(np.median(np.concatenate([_depths(source, points) for source in firsts])))
    errors = [(rng.normal(size=3), rng.normal(size=3)) for _ in views]
    scale = shift_px
    for _ in range(3):  # the shift is nearly proportional to the scale
        moves = [_move(s.lens, depth, scale, e) for s, e in zip(firsts, errors, strict=True)]
        shifts = [_mean_shift(s.lens, depth, m) for s, m in zip(firsts, moves, strict=True)]
        scale *= shift_px / float(np.mean(shifts))
    moves = [_move(s.lens, depth, scale, e) for s, e in zip(firsts, errors, strict=True)]
    return [_moved(view, move) for view, move in zip(views, moves, strict=True)]


def _first(view: TrainingView) -> ImageSource:
    return next(iter(view.source.images.values()))


def _depths(source: ImageSource, points: np.ndarray) -> np.ndarray:
    """Depths of the points that lie in an image, distortion aside."""
    at = points @ source.viewmat[:3, :3].numpy().T + source.viewmat[:3, 3].numpy()
    at, lens = at[at[:, 2] > NEAREST], source.lens
    x, y = lens.fx * at[:, 0] / at[:, 2] + lens.cx, lens.fy * at[:, 1] / at[:, 2] + lens.cy
    inside = (x > 0) & (x < lens.width) & (y > 0) & (y < lens.height)
    depths: np.ndarray = at[inside, 2]
    return depths


def _move(
    lens: Lens, depth: float, scale: float, error: tuple[np.ndarray, np.ndarray]
) -> Float64[Tensor, "4 4"]:
    """From the true camera's coordinates to the wrong one's: a turn and a step that shift pixels
    about as much."""
    turn, step = (scale / lens.fx * part for part in error)
    return rigid_transform(matrix_from_rotvec(turn), depth * step)


def _mean_shift(lens: Lens, depth: float, move: Float64[Tensor, "4 4"]) -> float:
    """How far points at a depth move on average over the image, pixels."""
    u, v = np.meshgrid(np.linspace(0.0, lens.width, 9), np.linspace(0.0, lens.height, 9))
    rays = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones_like(u)], axis=-1)
    at = depth * rays @ move[:3, :3].numpy().T + move[:3, 3].numpy()
    du = lens.fx * at[..., 0] / at[..., 2] + lens.cx - u
    dv = lens.fy * at[..., 1] / at[..., 2] + lens.cy - v
    return float(np.hypot(du, dv).mean())


def _moved(view: TrainingView, move: Float64[Tensor, "4 4"]) -> TrainingView:
    """All images of a view moved with its first."""
    true = _first(view).viewmat
    world = torch.linalg.inv(true) @ move @ true
    images = {
        modality: replace(source, viewmat=source.viewmat @ world)
        for modality, source in view.source.images.items()
    }
    return view.with_images(images)


def _noisy(
    views: Sequence[TrainingView], scene: SceneSource, rng: np.random.Generator
) -> list[TrainingView]:
    """Gaussian noise of ``NOISE_DB`` below the range in the thermal photos."""
    bounds = read_bounds(scene.root, scene.notes)
    seeds = rng.integers(2**32, size=len(views))

    def add(values: np.ndarray, seed: int) -> np.ndarray:
        if values.dtype.kind == "u":
            low, high = 0.0, float(np.iinfo(values.dtype).max)
        elif bounds is not None:
            low, high = bounds.min_c, bounds.max_c
        else:
            low, high = float(np.nanmin(values)), float(np.nanmax(values))
        sigma = (high - low) * 10.0 ** (-NOISE_DB / 20.0)
        noise = np.random.default_rng(seed).normal(0.0, sigma, values.shape[:2])
        noisy = values + noise.reshape(*noise.shape, *[1] * (values.ndim - 2))
        return _as_type(noisy, values.dtype)

    return [
        replace(view, thermal=partial(add, seed=int(seed)))
        for view, seed in zip(views, seeds, strict=True)
    ]


def _drifting(
    drift: Drift,
    views: Sequence[TrainingView],
    scene: SceneSource,
    rng: np.random.Generator,
) -> list[TrainingView]:
    """Thermal photos of a camera that drifts, taken in the order of their names; in °C."""
    bounds = read_bounds(scene.root, scene.notes)
    if bounds is None:
        raise ConfigError("the scene has no temperature_bounds.json, so a drift has no °C")
    ordered = sorted(views, key=lambda view: view.source.key)
    _, offsets_c = drift.series(len(views), rng)

    def add(values: np.ndarray, drift_c: float) -> np.ndarray:
        celsius = values.astype(np.float32)
        if values.dtype.kind == "u":
            celsius = bounds.to_celsius(celsius / np.iinfo(values.dtype).max)
        return (celsius + drift_c).astype(np.float32)

    return [
        replace(view, thermal=partial(add, drift_c=float(offset_c)), in_celsius=True)
        for view, offset_c in zip(ordered, offsets_c, strict=True)
    ]


def _thermal_missing(
    share: float, views: Sequence[TrainingView], scene: SceneSource, rng: np.random.Generator
) -> list[TrainingView]:
    """A share of the training views, drawn at random, without thermal photos; one keeps its own."""
    del scene
    most = len(views) - 1
    without = set(rng.permutation(len(views))[: min(math.floor(share * len(views)), most)].tolist())
    return [
        _without_thermal(view) if number in without else view for number, view in enumerate(views)
    ]


def _without_thermal(view: TrainingView) -> TrainingView:
    """The view without its thermal photo, unless it has no other."""
    others = {m: source for m, source in view.source.images.items() if m != THERMAL}
    return view.with_images(others) if others else view


def _thermal_quarter(
    views: Sequence[TrainingView], scene: SceneSource, rng: np.random.Generator
) -> list[TrainingView]:
    """Thermal photos of a quarter of the width and height, from a camera of their own."""
    del scene, rng
    return [_quartered(view) for view in views]


def _quartered(view: TrainingView) -> TrainingView:
    if THERMAL not in view.source.images:
        return view
    source = view.source.images[THERMAL]
    lens = source.lens
    small = replace(
        lens, width=lens.width // 4, height=lens.height // 4,
        fx=lens.fx / 4, fy=lens.fy / 4, cx=lens.cx / 4, cy=lens.cy / 4,
    )  # fmt: skip
    images = {**view.source.images, THERMAL: replace(source, lens=small, mask=None)}
    return replace(view.with_images(images), thermal=_mean_of_blocks)


def _mean_of_blocks(values: np.ndarray) -> np.ndarray:
    height, width = values.shape[0] // 4, values.shape[1] // 4
    blocks = values[: 4 * height, : 4 * width].reshape(height, 4, width, 4, *values.shape[2:])
    return _as_type(blocks.mean(axis=(1, 3)), values.dtype)


def _as_type(values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    if dtype.kind == "u":
        return np.round(values).clip(0, np.iinfo(dtype).max).astype(dtype)
    return values.astype(dtype)


REGIMES: dict[str, Change] = {
    "all": _keep_all,
    "views-12": partial(_fewer_views, 12),
    "views-8": partial(_fewer_views, 8),
    "poses-2px": partial(_wrong_poses, 2.0),
    "poses-4px": partial(_wrong_poses, 4.0),
    "every-pose-2px": partial(_wrong_poses, 2.0),
    "noise": _noisy,
    "drift": partial(_drifting, LITTLE_DRIFT),
    "drift-5c": partial(_drifting, MUCH_DRIFT),
    "missing-half": partial(_thermal_missing, 0.5),
    "missing-90": partial(_thermal_missing, 0.9),
    "thermal-quarter": _thermal_quarter,
}
"""By name: what becomes of the training views."""

ALSO_HELD_OUT = frozenset({"every-pose-2px"})
"""What becomes of the held-out views too, as where one program has found all poses."""


def _write(
    output: Path,
    scene: SceneSource,
    train: Sequence[TrainingView],
    held_out: Sequence[TrainingView],
) -> None:
    views = [*train, *held_out]
    names = _names([view.source.key for view in views])
    written = [_write_view(output, view, name) for view, name in zip(views, names, strict=True)]
    points = scene.points
    if points is not None:
        colors = (255.0 * points.colors.numpy()).round().clip(0, 255).astype(np.uint8)
        write_points(output / POINTS, points.positions.numpy(), colors)
    bounds = read_bounds(scene.root, scene.notes)
    if bounds is not None:
        write_bounds(output / BOUNDS, bounds.min_c, bounds.max_c)
    for path in sorted((scene.root / "truth").rglob("*")):
        if path.is_file():
            _link(path, output / path.relative_to(scene.root))
    firsts = [paths[0] for _, paths in written]
    write_transforms(
        output / TRANSFORMS,
        [frame for frame, _ in written],
        points=None if points is None else POINTS,
        split=(firsts[: len(train)], firsts[len(train) :]),
        modalities=sorted({modality for view in views for modality in view.source.images}),
        facts=world_json(scene.world),
    )


def _names(keys: Sequence[str]) -> list[str]:
    """File names without folders; with them where two would be equal."""
    stems = [key.rsplit("/", 1)[-1] for key in keys]
    return stems if len(set(stems)) == len(stems) else [key.replace("/", "_") for key in keys]


def _write_view(output: Path, view: TrainingView, name: str) -> tuple[dict, list[str]]:
    """Write a view's images and masks; its entry of ``transforms.json`` and the images' paths."""
    paths: dict[Modality, str] = {}
    for modality, source in view.source.images.items():
        folder = "images" if modality == RGB else modality.name
        change = view.thermal if modality == THERMAL else None
        suffix = source.path.suffix
        if change is not None and suffix.lower() in (".jpg", ".jpeg"):
            suffix = ".png"
        if view.in_celsius and modality == THERMAL:
            suffix = ".tiff"
        paths[modality] = f"{folder}/{name}{suffix}"
        if change is None:
            _link(source.path, output / paths[modality])
        else:
            _rewrite(source.path, output / paths[modality], change)
        if source.mask is not None:
            prefix = "" if modality == RGB else f"{modality}_"
            _link(source.mask, output / f"{prefix}masks/{name}{source.mask.suffix}")
    first = _first(view)
    others = {modality: path for modality, path in paths.items() if modality != RGB}
    images = view.source.images
    frame = frame_json(
        first.viewmat,
        paths.get(RGB),
        others,
        lens=first.lens,
        viewmats={modality: images[modality].viewmat for modality in others},
        lenses={modality: images[modality].lens for modality in others},
    )
    records = {modality: source.record for modality, source in images.items()}
    frame |= {f"{each}_{RECORD}": record.to_json() for each, record in records.items() if record}
    return frame, list(paths.values())


def _rewrite(source: Path, target: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with Image.open(source) as image:
        values = np.asarray(image)
    if values.dtype.kind == "i":  # 16 bits, as older versions of Pillow open them
        values = values.astype(np.uint16)
    Image.fromarray(change(values)).save(target)


def _link(source: Path, target: Path) -> None:
    """A hard link, or a copy where there can be none."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m mrgs_synth.regimes", description=__doc__)
    parser.add_argument("scene", type=Path, help="a scene folder with transforms.json")
    parser.add_argument("output", type=Path, help="the new folder")
    parser.add_argument("--name", required=True, choices=list(REGIMES), help="the regime")
    parser.add_argument("--seed", type=int, default=0, help="of what is chosen at random")
    options = parser.parse_args(arguments)
    make_regime(options.scene, options.output, options.name, options.seed)


if __name__ == "__main__":
    main()
