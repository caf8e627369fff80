"""A small trained run, and independent readers of what is exported from it."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mrgs.export.glb import EXTENSION
from mrgs.export.splats import SplatArrays
from mrgs.field.spherical_harmonics import C0
from mrgs.runs.baked import BakedModel, bake
from mrgs.runs.open import Run, load_run
from mrgs.scene import RGB, THERMAL, Camera, Scene, TemperatureRange
from mrgs.training import make_config, train

HERE = Path(__file__).parent
SPLAT_TRANSFORM = HERE / "node_modules" / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
GLTF_TRANSFORM = HERE / "node_modules" / "@gltf-transform" / "core"
NPM_INSTALL = "npm install --prefix tests/export --ignore-scripts --no-package-lock"

CELSIUS = TemperatureRange(10.0, 30.0)
PLY_TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4"}


def _read_ply(path: Path) -> tuple[list[str], dict[str, np.ndarray]]:
    """Comments, and the rows of each element by name; triangles as an [F, 3] array."""
    data = path.read_bytes()
    head, _, body = data.partition(b"end_header\n")
    comments, kinds, counts = [], {}, {}
    for line in head.decode("ascii").splitlines()[2:]:
        word, _, rest = line.partition(" ")
        if word == "comment":
            comments.append(rest)
        elif word == "element":
            name, count = rest.split()
            kinds[name], counts[name] = [], int(count)
        elif rest == "list uchar int vertex_indices":
            kinds[name] = [("count", "u1"), ("indices", "<i4", 3)]
        else:
            kind, label = rest.split()
            kinds[name].append((label, PLY_TYPES[kind]))
    elements, offset = {}, 0
    for name, kind in kinds.items():
        rows = np.frombuffer(body, np.dtype(kind), counts[name], offset)
        offset += rows.nbytes
        elements[name] = rows["indices"] if name == "face" else rows
    assert offset == len(body)
    return comments, elements


def _splats_from(rows: np.ndarray) -> SplatArrays:
    """The vertices of a 3DGS PLY."""
    bands = sum(name.startswith("f_rest_") for name in rows.dtype.names) // 3
    dc = np.stack([rows[f"f_dc_{c}"] for c in range(3)], axis=1)[:, None]
    rest = [
        np.stack([rows[f"f_rest_{c * bands + b}"] for c in range(3)], axis=1) for b in range(bands)
    ]
    return SplatArrays(
        np.stack([rows[axis] for axis in "xyz"], axis=1),
        np.stack([rows[f"rot_{i}"] for i in range(4)], axis=1),
        np.exp(np.stack([rows[f"scale_{i}"] for i in range(3)], axis=1)),
        1 / (1 + np.exp(-rows["opacity"])),
        np.concatenate([dc, np.stack(rest, axis=1)], axis=1) if bands else dc,
    )


def _splats_of(attributes: dict[str, list]) -> SplatArrays:
    """What gltf-transform read, as splats."""
    arrays = {name: np.array(values, dtype=np.float32) for name, values in attributes.items()}
    coefficients = [name for name in arrays if ":SH_DEGREE_" in name]
    return SplatArrays(
        arrays["POSITION"],
        np.roll(arrays[f"{EXTENSION}:ROTATION"], 1, axis=1),
        arrays[f"{EXTENSION}:SCALE"],
        arrays[f"{EXTENSION}:OPACITY"].reshape(-1),
        np.stack([arrays[name] for name in coefficients], axis=1),
    )


def _draw(splats: SplatArrays, camera: Camera) -> torch.Tensor:
    """The colours of the splats from a camera, [H, W, 3]."""
    sh = torch.zeros(len(splats), 16, 3)
    sh[:, : splats.sh.shape[1]] = torch.from_numpy(splats.sh)
    opacities = torch.from_numpy(splats.opacities)
    means, quats, scales = (
        torch.from_numpy(array) for array in (splats.means, splats.quats, splats.scales)
    )
    return (
        BakedModel(means, quats, scales, {RGB: opacities}, {RGB: sh}, opacities, None)
        .render(camera)[RGB]
        .image
    )


@pytest.fixture(scope="session")
def read_ply() -> Callable[[Path], tuple[list[str], dict[str, np.ndarray]]]:
    return _read_ply


@pytest.fixture(scope="session")
def splats_from() -> Callable[[np.ndarray], SplatArrays]:
    return _splats_from


@pytest.fixture(scope="session")
def splats_of() -> Callable[[dict[str, list]], SplatArrays]:
    return _splats_of


@pytest.fixture(scope="session")
def draw() -> Callable[[SplatArrays, Camera], torch.Tensor]:
    return _draw


@pytest.fixture(scope="session")
def run(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    config = make_config(preset="fast", max_steps=250, max_gaussians=400)
    # At full rates to the end, so that within so few steps colours come to depend on the view.
    config = replace(config, optimizer=replace(config.optimizer, slowdown_from=1.0))
    return load_run(train(small_scene, tmp_path_factory.mktemp("export") / "run", config).path)


@pytest.fixture(scope="session")
def scene(run: Run) -> Scene:
    return run.load_scene()


@pytest.fixture(scope="session")
def baked(run: Run, scene: Scene) -> BakedModel:
    return bake(run.model, scene.train_cameras, run.temperature)


@pytest.fixture
def make_baked() -> Callable[..., BakedModel]:
    """Random splats in a ball: ``make_baked(count, temperature=...)``."""

    def make(count: int = 50, temperature: TemperatureRange | None = CELSIUS) -> BakedModel:
        generator = torch.Generator().manual_seed(3)
        means = torch.randn(count, 3, generator=generator)
        quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=1)
        scales = torch.rand(count, 3, generator=generator) * 0.1 + 0.01
        opacities = torch.rand(count, 2, generator=generator) * 0.98 + 0.01
        sh = torch.randn(count, 16, 3, generator=generator) * 0.2
        temperatures = torch.rand(count, generator=generator)
        by_modality = {RGB: opacities[:, 0], THERMAL: opacities[:, 1]}
        return BakedModel(means, quats, scales, by_modality, {RGB: sh}, temperatures, temperature)

    return make


@pytest.fixture(scope="session")
def globe() -> BakedModel:
    """An opaque sphere of radius 0.5, of small splats: red and warm for z > 0, blue and cold
    below."""
    count = 6000
    index = torch.arange(count) + 0.5
    polar, around = torch.acos(1 - 2 * index / count), torch.pi * (1 + 5**0.5) * index
    ring = polar.sin()
    means = 0.5 * torch.stack([ring * around.cos(), ring * around.sin(), polar.cos()], dim=1)
    up = means[:, 2] > 0
    colors = torch.where(up[:, None], torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.9]))
    sh = torch.zeros(count, 16, 3)
    sh[:, 0] = (colors - 0.5) / C0
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    opacities = dict.fromkeys((RGB, THERMAL), torch.full((count,), 0.95))
    temperatures = torch.where(up, 0.75, 0.25)
    scales, scale = torch.full((count, 3), 0.012), TemperatureRange(10, 30)
    return BakedModel(means, quats, scales, opacities, {RGB: sh}, temperatures, scale)


@pytest.fixture
def wide_scene(scene: Scene) -> Scene:
    """The cameras of the small scene with enough pixels, and some from below."""

    def views(flip: bool):
        for view in scene.train:
            camera = view.cameras[RGB].resized(160, 120)
            turn = torch.diag(
                torch.tensor([1, -1, -1, 1] if flip else [1, 1, 1, 1], dtype=torch.float64)
            )
            camera = Camera(camera.K, camera.viewmat @ turn, camera.width, camera.height)
            yield replace(view, images={RGB: replace(view.images[RGB], camera=camera)})

    return replace(scene, train=(*views(False), *views(True)))


@pytest.fixture
def globe_under_sky(globe: BakedModel, wide_scene: Scene) -> BakedModel:
    """The same sphere, and cold splats all around it where training puts what lies far behind a
    scene."""
    ball = wide_scene.reach
    return replace(
        globe.map_tensors(lambda tensor: torch.cat([tensor] * 2)),
        means=torch.cat(
            [globe.means, ball.centre.float() + 2 * ball.background_distance * globe.means]
        ),
        scales=torch.cat(
            [globe.scales, torch.full_like(globe.scales, 0.05 * ball.background_distance)]
        ),
        temperatures=torch.cat([globe.temperatures, torch.zeros_like(globe.temperatures)]),
    )


@pytest.fixture
def splat_transform(tmp_path: Path) -> Callable[[Path], SplatArrays]:
    """Reads any splat file with PlayCanvas's splat-transform, by way of a PLY that it writes."""
    require_node(SPLAT_TRANSFORM)

    def read(path: Path) -> SplatArrays:
        output = tmp_path / f"{path.name}.read.ply"
        run_node(SPLAT_TRANSFORM, "--quiet", "--overwrite", path, output)
        return _splats_from(_read_ply(output)[1]["vertex"])

    return read


@pytest.fixture
def read_glb(tmp_path: Path) -> Callable[[Path], dict[str, Any]]:
    """Reads a glb with gltf-transform and checks it with Khronos's validator."""
    require_node(GLTF_TRANSFORM)

    def read(path: Path) -> dict[str, Any]:
        run_node(HERE / "read_glb.mjs", path, tmp_path / "glb.json")
        return json.loads((tmp_path / "glb.json").read_text())

    return read


def require_node(package: Path) -> None:
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    if not package.exists():
        pytest.skip(f"{package.name} is not installed: {NPM_INSTALL}")


def run_node(script: Path, *arguments: str | Path) -> None:
    process = subprocess.run(
        ["node", script, *arguments], capture_output=True, text=True, timeout=120
    )
    assert process.returncode == 0, process.stdout + process.stderr
