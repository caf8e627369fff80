"""A small scene of soft balls, in the layout of ThermoScenes."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
from PIL import Image

WIDTH, HEIGHT = 40, 30
MIN_C, MAX_C = 10.0, 30.0
"""Temperatures of the grey values 0 and 255."""


def orbit(angle: float) -> np.ndarray:
    """Camera to world, OpenGL axes, on a circle of radius 3 and looking at the origin."""
    position = np.array([3 * math.cos(angle), 3 * math.sin(angle), 1.0])
    backward = position / np.linalg.norm(position)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(backward, right), backward, position], axis=1)
    return pose


def blobs() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres [N, 3], colours [N, 3] and normalised temperatures [N] of soft balls about the
    origin."""
    rng = np.random.default_rng(5)
    return (
        rng.uniform(-0.6, 0.6, (25, 3)),
        rng.uniform(0.2, 1.0, (25, 3)),
        rng.uniform(0.2, 1.0, 25),
    )


def picture(pose: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The balls as one camera sees them, blended by hand: uint8 [H, W, C]."""
    centres, _, _ = blobs()
    in_camera = (centres - pose[:3, 3]) @ pose[:3, :3] * [1, -1, -1]
    depth = in_camera[:, 2]
    pixels = in_camera[:, :2] / depth[:, None] * WIDTH + [WIDTH / 2, HEIGHT / 2]
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    image, transmittance = np.zeros((HEIGHT, WIDTH, values.shape[1])), np.ones((HEIGHT, WIDTH))
    for i in np.argsort(depth):
        squared_px = (columns - pixels[i, 0]) ** 2 + (rows - pixels[i, 1]) ** 2
        alpha = 0.9 * np.exp(-0.5 * squared_px / (0.15 * WIDTH / depth[i]) ** 2)
        image += (alpha * transmittance)[..., None] * values[i]
        transmittance *= 1 - alpha
    return np.rint(255 * image).astype(np.uint8)


def write_scene(
    root: Path, rgb: bool = True, thermal: bool = True, two_cameras: bool = False
) -> Path:
    """A ThermoScenes folder: six views for training and two held out, 25 start points near the
    balls."""
    _, colors, temperatures = blobs()
    frames = []
    for index in range(8):
        name = f"frame_{'eval' if index in (2, 6) else 'train'}_{index:05d}.png"
        pose = orbit(2 * math.pi * index / 8)
        thermal_pose = orbit(2 * math.pi * index / 8 + 0.05) if two_cameras else pose
        frame = {"transform_matrix": pose.tolist()}
        for here, key, folder, content in (
            (rgb, "file_path", "images", picture(pose, colors)),
            (
                thermal,
                "thermal_file_path",
                "thermal",
                picture(thermal_pose, temperatures[:, None])[..., 0],
            ),
        ):
            if here:
                frame[key] = f"{folder}/{name}"
                (root / folder).mkdir(parents=True, exist_ok=True)
                Image.fromarray(content).save(root / folder / name)
        if two_cameras:
            frame["thermal_transform_matrix"] = thermal_pose.tolist()
        frames.append(frame)
    lens = {
        "fl_x": WIDTH,
        "fl_y": WIDTH,
        "cx": WIDTH / 2,
        "cy": HEIGHT / 2,
        "w": WIDTH,
        "h": HEIGHT,
    }
    (root / "transforms.json").write_text(
        json.dumps({"camera_model": "PINHOLE", **lens, "frames": frames})
    )
    bounds = {"absolute_min_temperature": MIN_C, "absolute_max_temperature": MAX_C}
    (root / "temperature_bounds.json").write_text(json.dumps(bounds))
    _write_points(root / "sparse_pc.ply")
    return root


def _write_points(path: Path) -> None:
    centres, colors, _ = blobs()
    positions = centres + np.random.default_rng(6).normal(0, 0.05, centres.shape)
    properties = [f"property float {axis}" for axis in "xyz"] + [
        f"property uchar {c}" for c in ("red", "green", "blue")
    ]
    rows = [
        " ".join([*(f"{x:.6f}" for x in position), *(str(round(255 * c)) for c in color)])
        for position, color in zip(positions, colors, strict=True)
    ]
    header = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *properties, "end_header"]
    path.write_text("\n".join([*header, *rows]) + "\n")
