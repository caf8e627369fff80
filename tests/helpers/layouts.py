"""Writes small scenes in every layout."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

WIDTH, HEIGHT = 24, 16
COLMAP_IDS = {
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 1,
    "SIMPLE_RADIAL": 2,
    "RADIAL": 3,
    "OPENCV": 4,
    "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6,
    "FOV": 7,
    "SIMPLE_RADIAL_FISHEYE": 8,
    "RADIAL_FISHEYE": 9,
    "THIN_PRISM_FISHEYE": 10,
}


def orbit_pose(angle: float, radius: float = 3.0) -> np.ndarray:
    """Camera to world, OpenGL axes, on a circle and looking at the origin."""
    position = np.array([radius * math.cos(angle), radius * math.sin(angle), 1.0])
    backward = position / np.linalg.norm(position)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(backward, right), backward, position], axis=1)
    return pose


class SceneWriter:
    """A scene folder under construction."""

    def __init__(self, root: Path) -> None:
        self.root = root
        root.mkdir()

    def image(
        self, name: str, mode: str = "RGB", size: tuple[int, int] = (WIDTH, HEIGHT), seed: int = 0
    ) -> Path:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        rng = np.random.default_rng(seed)
        shape = (size[1], size[0])
        if mode == "F":
            pixels = rng.uniform(12.3, 31.8, shape).astype(np.float32)
        elif mode == "I;16":
            pixels = rng.integers(0, 65536, shape, dtype=np.uint16)
        else:
            pixels = rng.integers(
                0, 256, (*shape, len(mode)) if len(mode) > 1 else shape, dtype=np.uint8
            )
        Image.fromarray(pixels).save(path)
        return path

    def json(self, name: str, content: Any) -> Path:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content))
        return path

    def thermoscenes(
        self, train: int = 4, held_out: int = 2, thermal_mode: str = "L"
    ) -> dict[str, Any]:
        """Images and bounds on disk; returns the content of transforms.json, still to be
        written."""
        frames = []
        names = [f"frame_train_{i:05d}" for i in range(train)] + [
            f"frame_eval_{i:05d}" for i in range(held_out)
        ]
        suffix = ".tiff" if thermal_mode == "F" else ".PNG"
        for index, name in enumerate(names):
            self.image(f"images/{name}{('.jpg', '.JPG', '.png')[index % 3]}", seed=index)
            self.image(f"thermal/{name}{suffix}", thermal_mode, seed=100 + index)
            frames.append(
                {
                    "file_path": f"images/{name}.png",
                    "thermal_file_path": f"thermal/{name}.png",
                    "transform_matrix": orbit_pose(0.7 * index).tolist(),
                }
            )
        intrinsics = {"fl_x": 20.0, "fl_y": 22.0, "cx": 12.5, "cy": 7.5, "w": WIDTH, "h": HEIGHT}
        return {
            "camera_model": "OPENCV",
            **intrinsics,
            "k1": 0.0,
            "k2": 0.0,
            "p1": 0.0,
            "p2": 0.0,
            "frames": frames,
        }

    def transforms(self, content: Any) -> Path:
        return self.json("transforms.json", content)

    def bounds(self, low: Any, high: Any, name: str = "temperature_bounds.json") -> Path:
        return self.json(name, {"absolute_min_temperature": low, "absolute_max_temperature": high})

    def colmap(
        self,
        names: list[str],
        binary: bool,
        model: str = "OPENCV",
        parameters: tuple[float, ...] = (20.0, 22.0, 12.5, 7.5, -0.05, 0.01, 0.001, -0.002),
        folder: str = "sparse/0",
    ) -> Path:
        """One camera, an image per name on an orbit, three points."""
        path = self.root / folder
        path.mkdir(parents=True, exist_ok=True)
        poses = [_colmap_pose(0.5 * index) for index in range(len(names))]
        points = [
            (0.5, -0.25, 0.125, 255, 0, 51),
            (1.0, 2.0, 3.0, 0, 255, 0),
            (-80.0, 1.0, 0.0, 1, 2, 3),
        ]
        write = _write_binary if binary else _write_text
        write(path, model, parameters, names, poses, points)
        return path


def _colmap_pose(angle: float) -> tuple[float, ...]:
    """Quaternion wxyz about the z axis, then a translation."""
    return (math.cos(angle), 0.0, 0.0, math.sin(angle), 0.1 * angle, -0.2, 3.0)


def _write_text(path, model, parameters, names, poses, points) -> None:
    def row(*values) -> str:
        return " ".join(repr(value) if isinstance(value, float) else str(value) for value in values)

    (path / "cameras.txt").write_text(f"# a comment\n{row(1, model, WIDTH, HEIGHT, *parameters)}\n")
    images = [
        f"{row(i + 1, *pose, 1, name)}\n1.5 2.5 -1\n"
        for i, (pose, name) in enumerate(zip(poses, names, strict=True))
    ]
    (path / "images.txt").write_text("# a comment\n" + "".join(images))
    lines = [row(i + 1, *point, 0.5, 1, 0, 2, 3) + "\n" for i, point in enumerate(points)]
    (path / "points3D.txt").write_text("# a comment\n" + "".join(lines))


def _write_binary(path, model, parameters, names, poses, points) -> None:
    camera = struct.pack("<QIiQQ", 1, 1, COLMAP_IDS[model], WIDTH, HEIGHT)
    (path / "cameras.bin").write_bytes(camera + struct.pack(f"<{len(parameters)}d", *parameters))
    images = struct.pack("<Q", len(names))
    for index, (pose, name) in enumerate(zip(poses, names, strict=True)):
        images += struct.pack("<I7dI", index + 1, *pose, 1) + name.encode() + b"\0"
        images += struct.pack("<Q2dq", 1, 1.5, 2.5, -1)
    (path / "images.bin").write_bytes(images)
    body = struct.pack("<Q", len(points))
    for index, point in enumerate(points):
        body += struct.pack("<Q3d3BdQ4I", index + 1, *point, 0.5, 2, 0, 2, 3, 4)
    (path / "points3D.bin").write_bytes(body)
