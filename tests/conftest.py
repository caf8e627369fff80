"""What holds for every test: quiet threads, checked shapes, a device; and small scenes with known
contents."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

os.environ.setdefault(
    "OMP_WAIT_POLICY", "PASSIVE"
)  # before torch is loaded: spinning threads starve each other
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # nor do small matrices gain by threads

import numpy as np
import pytest
import torch
from hypothesis import settings
from jaxtyping import install_import_hook
from PIL import Image

if TYPE_CHECKING:
    from mrgs.scene import Pixels

if not torch.cuda.is_available():
    os.environ.setdefault(
        "TRITON_INTERPRET", "1"
    )  # before Triton is loaded: its kernels then run on CPU tensors

SOURCE = Path(__file__).parents[1] / "src" / "mrgs"
UNCHECKED = (
    "mrgs.kernels",
    "mrgs.app.terminal",
    "mrgs.app.cli",
    "mrgs.app.commands",
)
"""The hook's decorators break Numba's cache and Triton's reading of a kernel's source; cli imports
what it annotates only when it is needed."""


def _checked_modules() -> list[str]:
    """Every module but the unchecked; never a package, because the hook takes all that is below
    it."""
    paths = [path.relative_to(SOURCE.parent).with_suffix("") for path in SOURCE.rglob("*.py")]
    names = [".".join(path.parts) for path in paths if path.name != "__init__"]
    return [name for name in sorted(names) if not name.startswith(UNCHECKED)]


# Shapes and types stand in the signatures and are checked in the tests alone, if beartype is there:
# a machine lent for its GPU may lack it. An int counts as a float (PEP 484).
if importlib.util.find_spec("beartype") is not None:
    install_import_hook(
        _checked_modules(), "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"
    )

# The same examples on every machine, and no verdict from how busy it is.
settings.register_profile("mrgs", deadline=None, derandomize=True)
settings.load_profile("mrgs")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Leaves out what needs a GPU, where there is none."""
    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


@pytest.fixture(autouse=True, scope="session")
def auto_is_the_cpu() -> Iterator[None]:
    """With a GPU, too, a test runs on the CPU unless it says otherwise: many compare bits."""
    from mrgs.system import gpu

    choose = gpu.choose_device
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gpu, "choose_device", lambda name: choose("cpu" if name == "auto" else name))
        yield


@pytest.fixture
def gpu_device() -> Iterator[str]:
    """Where the Triton kernels run: "cuda"; or, without a CUDA device, "cpu", where they are
    interpreted."""
    pytest.importorskip("triton")
    if torch.cuda.is_available():
        yield "cuda"
        return
    from mrgs.system import gpu

    with gpu.interpreted():
        yield "cpu"


@contextmanager
def sync_debug_mode(mode: str) -> Iterator[None]:
    """torch tells of what makes the host wait for the GPU: "warn" or "error". Its notice that it
    may miss some is not an error."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings(
                "ignore", "Synchronization debug mode is a prototype feature", UserWarning
            )
            torch.cuda.set_sync_debug_mode(mode)
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.fixture
def telling_of_waits() -> Callable[[str], AbstractContextManager[None]]:
    """``with telling_of_waits("error"):``, for a real GPU."""
    return sync_debug_mode


class CountingImage:
    """A float image of 4×5×1 (80 bytes), with a mask of 20 bytes if asked for, which counts how
    often it is read."""

    def __init__(self, masked: bool = False) -> None:
        from mrgs.scene import Camera, PosedImage

        self.reads = 0
        self._valid = torch.ones(4, 5, dtype=torch.bool) if masked else None
        camera = Camera(torch.eye(3, dtype=torch.float64), torch.eye(4, dtype=torch.float64), 5, 4)
        self.posed = PosedImage(camera, self._read)

    def _read(self) -> Pixels:
        from mrgs.scene import Pixels

        self.reads += 1
        return Pixels(torch.full((4, 5, 1), 0.5), self._valid)


@pytest.fixture(scope="session")
def counting_image() -> type[CountingImage]:
    return CountingImage


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


@pytest.fixture(scope="session")
def small_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both modalities through one camera; only to be read."""
    return write_scene(tmp_path_factory.mktemp("scenes") / "balls")


@pytest.fixture
def make_scene(tmp_path: Path) -> Callable[..., Path]:
    """Writes a scene of its own into the test's folder: ``make_scene(rgb=..., thermal=...,
    two_cameras=...)``."""
    return lambda **options: write_scene(tmp_path / "scene", **options)
