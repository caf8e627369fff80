"""How far check points are off in a scene with four control points: by a similarity alone, and
after the adjustment.

    python -m benchmarks.control_points FOLDER --seeds 627 628 629

Each seed is a façade of 36 × 8 m with bays, photographed along a line through a lens with two
radial and two tangential coefficients and its centre off the image's: structure from motion, which
fits one radial coefficient, bends the façade. Marks have 0.4 px of noise. ``--scene SCENE``, one
of ``mrgs synth --scene facade``, has a lens without distortion, and takes its place.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import zoom

from mrgs.data import load_scene
from mrgs.data.transforms import pinhole_lens
from mrgs.prepare.contract import rms_m
from mrgs.prepare.control import ControlPoint, ControlPoints, place_by_control
from mrgs.prepare.sfm.reconstruct import adjusted, reconstruct
from mrgs.scene import RGB
from mrgs.scene.lens import Lens
from mrgs_synth.cameras import look_at

LENGTH_M, HEIGHT_M, PIXELS_PER_M = 36.0, 8.0, 110
WIDTH_PX, HEIGHT_PX, VIEWS = 800, 600, 22
LONG = {
    "corners": [(1.5, 0.0, 0.8), (34.5, 0.0, 1.0), (2.0, 0.0, 7.2), (34.0, 0.0, 7.0)],
    "spread": [(1.5, 0.0, 0.8), (34.5, 0.0, 7.0), (12.0, -1.0, 7.0), (24.0, -1.0, 1.0)],
    "check": [
        (x, y, z) for x in (5.0, 10.0, 14.5, 18.0, 21.5, 26.0, 31.0)
        for y, z in ((0.0, 1.2), (0.0, 6.5), (-1.0, 4.0))
    ],
}  # fmt: skip
SYNTH = {
    "corners": [(-5.0, 0.0, 0.5), (5.2, 0.0, 0.6), (-5.3, 0.0, 5.9), (5.0, 0.0, 5.7)],
    "spread": [(-5.0, 0.0, 0.5), (5.2, 0.0, 5.6), (-0.1, -1.25, 2.7), (2.4, -1.25, 2.7)],
    "check": [
        (0.1, 0.0, 1.2), (0.0, 0.0, 5.5), (2.8, 0.0, 3.0), (-3.0, 0.0, 3.2), (-0.1, -1.25, 2.7),
        (1.0, -1.25, 2.7), (-2.0, 0.0, 0.3), (3.0, 0.0, 5.8),
    ],
}  # fmt: skip
"""Metres east, north and up: two choices of four control points, and the check points."""

Cameras = dict[str, tuple[np.ndarray, Lens]]
"""World to camera, and lens, by view."""


def photograph(folder: Path, seed: int) -> Cameras:
    """Render the photos of a façade into ``folder/images``."""
    rng = np.random.default_rng(seed)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    texture = paint(rng)
    walls = [(0.0, 0.0, LENGTH_M, 0.0, HEIGHT_M, 0.0, 0.0)]
    for _ in range(26):
        x, z = rng.uniform(0, LENGTH_M - 2.5), rng.uniform(0.3, HEIGHT_M - 2)
        far, wide, high = rng.uniform((0.3, 0.8, 0.6), (1.4, 2.4, 1.8))
        walls.append((-far, x, x + wide, z, z + high, rng.uniform(0, 5), rng.uniform(0, 2)))
    focal, (cx, cy) = 640 * rng.uniform(0.97, 1.03), rng.uniform(-8, 8, 2)
    radial = (rng.uniform(-0.15, -0.09), 0.05, 0.0, 0.0)
    centre = WIDTH_PX / 2 + cx, HEIGHT_PX / 2 + cy
    tangential = (rng.uniform(-1e-3, 1e-3), rng.uniform(-1e-3, 1e-3))
    lens = Lens(WIDTH_PX, HEIGHT_PX, focal, focal, *centre, radial, tangential)
    u, v = np.meshgrid(np.arange(WIDTH_PX) + 0.5, np.arange(HEIGHT_PX) + 0.5)
    rays = np.stack([*lens.rays(u, v), np.ones_like(u)], axis=-1)
    cameras: Cameras = {}
    for index in range(VIEWS):
        along = 1.5 + (LENGTH_M - 3) * index / (VIEWS - 1)
        height = 2.0 if index % 2 else 3.6
        eye = np.array([along, -9.0, height]) + rng.normal(0, (0.15, 0.4, 0.2))
        aim = [eye[0] + (1.5 if index % 3 == 0 else -1.0) + rng.normal(0, 0.3), 0.0, HEIGHT_M / 2]
        viewmat = look_at(eye, np.array(aim))
        pixels = shade(rays @ viewmat[:3, :3], eye, walls, texture)
        noisy = np.clip(pixels + rng.normal(0, 3, pixels.shape), 0, 255).astype(np.uint8)
        name = f"p{index:03d}"
        Image.fromarray(noisy).save(folder / "images" / f"{name}.jpg", quality=93)
        cameras[name] = viewmat, lens
    return cameras


def paint(rng: np.random.Generator) -> np.ndarray:
    """A texture of noise at several scales and of rectangles."""
    shape = int(HEIGHT_M * PIXELS_PER_M), int(LENGTH_M * PIXELS_PER_M)
    texture = np.zeros((*shape, 3), np.float32)
    for step in (2, 4, 8, 20, 60):
        noise = rng.normal(0, 1, (shape[0] // step + 2, shape[1] // step + 2, 3))
        texture += zoom(noise, (step, step, 1), order=1)[: shape[0], : shape[1]]
    texture = texture / texture.std() * 28 + 128
    for _ in range(900):
        top, left = rng.integers(0, (shape[0] - 30, shape[1] - 60))
        high, wide = rng.integers((4, 4), (30, 60))
        texture[top : top + high, left : left + wide] = rng.uniform(20, 235, 3)
    return np.clip(texture, 0, 255)


def shade(
    rays: np.ndarray, eye: np.ndarray, walls: Sequence[tuple[float, ...]], texture: np.ndarray
) -> np.ndarray:
    """Colours of the nearest of the walls, which all face south, along rays [H, W, 3]."""
    nearest = np.full(rays.shape[:2], np.inf)
    colors = np.full(rays.shape, 200.0, np.float32)
    for y, left, right, low, high, shift_x, shift_z in walls:
        distance = (y - eye[1]) / rays[..., 1]
        x, z = eye[0] + distance * rays[..., 0], eye[2] + distance * rays[..., 2]
        hit = (distance > 0) & (distance < nearest)
        hit &= (x >= left) & (x < right) & (z >= low) & (z < high)
        column = np.clip((x[hit] + shift_x) % LENGTH_M * PIXELS_PER_M, 0, texture.shape[1] - 1.01)
        row = np.clip((z[hit] + shift_z) % HEIGHT_M * PIXELS_PER_M, 0, texture.shape[0] - 1.01)
        i, j = row.astype(int), column.astype(int)
        down, across = (row - i)[:, None], (column - j)[:, None]
        upper = texture[i, j] * (1 - across) + texture[i, j + 1] * across
        lower = texture[i + 1, j] * (1 - across) + texture[i + 1, j + 1] * across
        colors[hit], nearest[hit] = upper * (1 - down) + lower * down, distance[hit]
    return colors


def marks(
    place: Sequence[float], cameras: Cameras, noise_px: float, most: int, rng: np.random.Generator
) -> dict[str, tuple[float, float]]:
    """Clicks on a place in some of the photos that show it."""
    found = {}
    for name, (viewmat, lens) in sorted(cameras.items()):
        x, y, z = viewmat[:3, :3] @ np.array(place) + viewmat[:3, 3]
        if z <= 0 or max(abs(x), abs(y)) > 0.8 * z:
            continue
        u, v = lens.distort(np.array([x / z]), np.array([y / z]))
        pixel = np.array([lens.fx * u[0] + lens.cx, lens.fy * v[0] + lens.cy])
        if ((pixel > 5) & (pixel < np.array([lens.width, lens.height]) - 5)).all():
            found[name] = pixel + rng.normal(0, noise_px, 2)
    chosen = rng.permutation(list(found))[:most]
    return {str(name): (float(found[name][0]), float(found[name][1])) for name in chosen}


def measure(
    folder: Path,
    cameras: Cameras,
    places: dict[str, list[tuple[float, float, float]]],
    options: argparse.Namespace,
) -> dict[str, np.ndarray]:
    """RMS of control and check points, m, by choice of the control points and method."""
    images = {path.stem: path for path in sorted((folder / "images").glob("*.jpg"))}
    work = folder / "work"
    found = reconstruct(images, work, lambda step, done, total: None, modality=RGB)
    adjust = partial(adjusted, work / "sfm", RGB, lambda step, done, total: None)
    results: dict[str, list[list[float | None]]] = {}
    for choice in ("corners", "spread"):
        for trial in range(options.trials):
            rng = np.random.default_rng([trial, 7])
            click = partial(
                marks, cameras=cameras, noise_px=options.noise, most=options.marks, rng=rng
            )
            points = {f"C{i}": ControlPoint(click(p), p) for i, p in enumerate(places[choice])}
            points |= {
                f"K{i}": ControlPoint(click(p), p, True) for i, p in enumerate(places["check"])
            }
            for method, change in (("similarity", None), ("adjusted", adjust)):
                _, placed = place_by_control(found, ControlPoints(points), {}, change)
                errors = [rms_m(placed.control, role) for role in ("control", "check")]
                results.setdefault(f"{choice}, {method}", []).append(errors)
    squares = {name: np.array(errors, float) ** 2 for name, errors in results.items()}
    return {name: np.sqrt(each.mean(axis=0)) for name, each in squares.items()}


def main() -> None:
    """Print RMS errors of control and check points in cm, over the trials' clicks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, nargs="*", default=[])
    parser.add_argument("--scene", type=Path, action="append", default=[])
    parser.add_argument("--noise", type=float, default=0.4)
    parser.add_argument("--marks", type=int, default=5)
    parser.add_argument("--trials", type=int, default=4)
    options = parser.parse_args()
    for seed in options.seeds:
        folder = options.folder / f"facade-{seed}"
        cameras = photograph(folder, seed)
        report(f"seed {seed}", measure(folder, cameras, LONG, options))
    for path in options.scene:
        views = load_scene(path).views
        cameras = {
            view.name: (view.camera.viewmat.numpy(), pinhole_lens(view.camera)) for view in views
        }
        folder = options.folder / path.name
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / "images").exists():
            (folder / "images").symlink_to((path / "images").resolve())
        report(path.name, measure(folder, cameras, SYNTH, options))


def report(name: str, results: dict[str, np.ndarray]) -> None:
    """Print the errors of a façade."""
    for method, (control, check) in results.items():
        print(f"{name}, {method}: control {100 * control:.2f} cm, check {100 * check:.2f} cm")


if __name__ == "__main__":
    main()
