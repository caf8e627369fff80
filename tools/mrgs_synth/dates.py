"""Two dates of one object: what was repaired, broke or spread between them is known exactly.

Between the dates the weather changes, the sun moves, and some round patches change. The second
scene has cameras and coordinates of its own, and drift of its own. Beside the first scene's truth,
``truth/after/NAME.tiff`` is what an ideal camera reads from its training cameras on the second
date, °C, and ``truth/changes.json`` lists the patches.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mrgs.scene import Camera
from mrgs_synth.cameras import CameraArc, Frame
from mrgs_synth.generate import RAYS_PER_SIDE, STAGES, photograph_stage, stage_cameras
from mrgs_synth.hits import Hits, Triangles, first_hits
from mrgs_synth.imager import CameraName
from mrgs_synth.radiometry import exact_temperature
from mrgs_synth.shapes import rotation_z
from mrgs_synth.stage import Solid, Stage, TemperatureField
from mrgs_synth.write import TEMPERATURE_STEP_C, write_float_tiff

ChangeKind = Literal["new", "gone", "grown", "shrunk", "warmer", "colder", "same"]
KINDS: tuple[ChangeKind, ...] = ("new", "gone", "grown", "shrunk", "warmer", "colder", "same")

EDGE = 0.15
"""Width of the edge of a patch, in its radii."""

SPREAD = 1.7
"""A patch that grows or shrinks changes its radius by this factor."""

RADIUS_PX = (3.5, 7.0)
"""Radii of the patches, pixels of the photos."""

LEAST_SEEN = 5
"""Training cameras that see a patch."""

WEATHER_C, OWN_WEATHER_C = 4.0, 0.3
"""The weather warms or cools everything by at most this, and each solid by so much more or less."""

SUN_TURN = 1 / 15
"""Share of a whole turn by which the sky moves between the dates."""


class Patch(NamedTuple):
    """A round patch on a solid: what it adds to its temperature, K, within a radius, m."""

    radius_m: float
    kelvin: float


@dataclass(frozen=True)
class Change:
    """A patch before and after; ``center`` in the first scene's coordinates."""

    kind: ChangeKind
    solid: str
    center: tuple[float, float, float]
    before: Patch
    after: Patch


def synthesize_dates(
    before: Path,
    after: Path,
    *,
    scene: str,
    seed: int,
    changes: int = 8,
    width: int = 160,
    height: int = 120,
    train_views: int = 32,
    samples: int = 16,
    camera: CameraName = "wiris-like",
    scale: float | None = None,
) -> list[Change]:
    """Generate two scenes of one object with known changes; returns these.

    Args:
        before: the first scene's new folder, in metres.
        after: the second one's.
        scene: of ``generate.STAGES``.
        seed: of everything.
        changes: number of patches, which take turns of ``KINDS``.
        width: image width in pixels.
        height: image height in pixels.
        train_views: of each date.
        samples: paths per pixel.
        camera: of both dates; its drift and shading differ.
        scale: of the second scene's coordinates; 1 for metres, None to draw one.

    Raises:
        ConfigError: a folder holds a scene already, or Mitsuba is not installed.
    """
    rng = np.random.default_rng([seed, 70])
    stage = STAGES[scene](seed)
    cameras = stage_cameras(stage, width, height, train_views, 2, seed)
    found = _placed(stage, [each for name, each in cameras.items() if "_train_" in name],
                    changes, rng)  # fmt: skip
    first = _patched(stage, [(each, each.before) for each in found])
    second = _weathered(_patched(stage, [(each, each.after) for each in found]), rng)
    photograph_stage(
        before, first, cameras, samples=samples, seed=seed, every_truth=True, camera=camera,
        parameters={"scene": scene, "date": 1},
    )  # fmt: skip
    turn = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    chosen = float(rng.uniform(0.4, 2.5)) if scale is None else scale
    frame = Frame(chosen, turn, rng.uniform(-5, 5, 3))
    moved = replace(second, cameras=_other_path(second, rng))
    photograph_stage(
        after, moved, stage_cameras(moved, width, height, train_views, 2, seed + 5000),
        samples=samples, seed=seed + 5000, every_truth=False, camera=camera,
        parameters={"scene": scene, "date": 2}, frame=frame,
    )  # fmt: skip
    _write_truth(before, second, cameras, found, frame)
    return found


def _write_truth(
    folder: Path,
    second: Stage,
    cameras: dict[str, Camera],
    changes: Sequence[Change],
    frame: Frame,
) -> None:
    triangles = Triangles.of(second.solids)
    exact = {
        name: exact_temperature(camera, second, triangles, RAYS_PER_SIDE)
        for name, camera in cameras.items()
    }
    write_changes(folder, changes, exact, frame)


def write_changes(
    folder: Path,
    changes: Sequence[Change],
    exact_c: Mapping[str, Float[np.ndarray, "h w"]],
    frame: Frame,
) -> None:
    """Write ``truth/after`` of named views, and ``truth/changes.json``, into a scene's folder;
    ``frame`` is that of the second date."""
    (folder / "truth/after").mkdir()
    for name, exact in exact_c.items():
        write_float_tiff(folder / f"truth/after/{name}.tiff", exact, TEMPERATURE_STEP_C)
    placed = {"scale": frame.scale, "rotation": frame.rotation.tolist()}
    facts = {"changes": [_json(each) for each in changes]}
    facts["second_from_first"] = [placed | {"shift": frame.shift.tolist()}]
    (folder / "truth/changes.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


def _json(change: Change) -> dict[str, object]:
    facts = asdict(change)
    return facts | {"before": change.before._asdict(), "after": change.after._asdict()}


def _other_path(stage: Stage, rng: np.random.Generator) -> CameraArc:
    """Another walk around the object."""
    path, turn = stage.cameras, rng.uniform(-6, 6)
    rings = tuple(
        (float(elevation + rng.uniform(-3, 3)), float(distance * rng.uniform(0.93, 1.07)))
        for elevation, distance in path.rings
    )
    first, last = path.azimuth_deg
    return replace(path, azimuth_deg=(first + turn, last + turn), rings=rings)


def _weathered(stage: Stage, rng: np.random.Generator) -> Stage:
    """The stage on another day: warmer or colder, and the sun elsewhere."""
    common = float(rng.uniform(1.0, WEATHER_C) * rng.choice([-1, 1]))
    solids = tuple(
        replace(each, temperature_c=_sum(each.temperature_c, common + float(own)))
        for each, own in zip(
            stage.solids, rng.uniform(-OWN_WEATHER_C, OWN_WEATHER_C, len(stage.solids)), strict=True
        )
    )
    sky = stage.sky
    if isinstance(sky, np.ndarray):
        sky = np.roll(sky, round(SUN_TURN * sky.shape[1]), axis=1)
    return replace(
        stage,
        solids=solids,
        sky=sky,
        beyond_c=_sum(stage.beyond_c, 1.5 * common),
        surroundings_c=_sum(stage.surroundings_c, common),
    )


def _sum(field: TemperatureField, kelvin: float) -> TemperatureField:
    return lambda points: field(points) + kelvin


def _patched(stage: Stage, patches: Sequence[tuple[Change, Patch]]) -> Stage:
    def patched(solid: Solid) -> Solid:
        for change, patch in patches:
            if change.solid == solid.name and patch.kelvin:
                center = np.array(change.center) - np.array(solid.position)
                local = center @ rotation_z(solid.yaw_deg)
                solid = replace(solid, temperature_c=_with_patch(solid.temperature_c, local, patch))
        return solid

    return replace(stage, solids=tuple(map(patched, stage.solids)))


def _with_patch(
    field: TemperatureField, center: Float[np.ndarray, "3"], patch: Patch
) -> TemperatureField:
    def celsius(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        distance = np.linalg.norm(points - center, axis=1) / patch.radius_m
        return field(points) + patch.kelvin * np.clip((1 - distance) / EDGE + 0.5, 0, 1)

    return celsius


def _placed(
    stage: Stage, cameras: Sequence[Camera], count: int, rng: np.random.Generator
) -> list[Change]:
    """Patches on even places of non-metals that enough cameras see, apart from each other."""
    triangles = Triangles.of(stage.solids)
    hits = [first_hits(camera, triangles) for camera in cameras]
    found: list[Change] = []
    for _ in range(4000):
        if len(found) == count:
            break
        number = int(rng.integers(len(cameras)))
        camera, seen = cameras[number], hits[number]
        kind = KINDS[len(found) % len(KINDS)]
        radius_px = float(rng.uniform(*RADIUS_PX))
        wide = radius_px * (SPREAD if kind in ("grown", "shrunk") else 1.0)
        margin = int(np.ceil(wide)) + 2
        if kind in ("grown", "shrunk"):
            margin, radius_px = margin + 1, max(radius_px, 4.5)
        row = int(rng.integers(margin, camera.height - margin))
        column = int(rng.integers(margin, camera.width - margin))
        pixel_m = float(seen.depth_m[row, column]) / float(camera.K[0, 0])
        solid = seen.solid[row, column]
        around = (
            slice(row - margin, row + margin + 1),
            slice(column - margin, column + margin + 1),
        )
        if solid < 0 or (seen.solid[around] != solid).any():
            continue
        if np.ptp(seen.depth_m[around]) > 2 * margin * pixel_m:  # steep, or not one surface
            continue
        material = stage.solids[solid].material
        center = seen.points[row, column]
        radius_m = radius_px * pixel_m
        reach = radius_m * (SPREAD if kind in ("grown", "shrunk") else 1.0)
        if material.emissivity < 0.8 or material.heat_mirror:
            continue
        if sum(map(lambda c, h: _sees(c, h, center, margin), cameras, hits)) < LEAST_SEEN:
            continue
        if any(np.linalg.norm(center - each.center) < reach + _reach(each) + 8 * pixel_m
               for each in found):  # fmt: skip
            continue
        found.append(_change(kind, stage.solids[solid].name, center, radius_m, rng))
    return found


def _reach(change: Change) -> float:
    return max(change.before.radius_m, change.after.radius_m)


def _sees(camera: Camera, hits: Hits, point: Float[np.ndarray, "3"], margin: int) -> bool:
    pixel, depth = camera.project(torch.from_numpy(point))
    size = pixel.new_tensor([camera.width, camera.height])
    if not bool(((pixel >= margin) & (pixel < size - margin)).all()):  # also NaN: behind it
        return False
    x, y = pixel.long().tolist()
    return bool(abs(hits.depth_m[y, x] - float(depth)) < 0.02 * float(depth))


def _change(
    kind: ChangeKind,
    solid: str,
    center: Float[np.ndarray, "3"],
    radius_m: float,
    rng: np.random.Generator,
) -> Change:
    sign = float(rng.choice([-1, 1]))
    size, more = float(rng.uniform(1.4, 6.0)), float(rng.uniform(1.4, 3.5))
    small, large, nothing = radius_m, SPREAD * radius_m, Patch(radius_m, 0.0)
    patch = Patch(radius_m, sign * size)
    before, after = {
        "new": (nothing, patch),
        "gone": (patch, nothing),
        "grown": (Patch(small, sign * size), Patch(large, sign * size)),
        "shrunk": (Patch(large, sign * size), Patch(small, sign * size)),
        "warmer": (patch, Patch(radius_m, sign * size + more)),
        "colder": (patch, Patch(radius_m, sign * size - more)),
        "same": (patch, patch),
    }[kind]
    x, y, z = (float(each) for each in center)
    return Change(kind, solid, (x, y, z), before, after)
