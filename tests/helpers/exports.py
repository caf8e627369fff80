"""Independent readers of exported files, and a small baked model."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import torch

from mrgs.export.glb import EXTENSION
from mrgs.export.splats import SplatArrays
from mrgs.rasterizer.contract import Dilation
from mrgs.runs.baked import BakedModel
from mrgs.scene import RGB, THERMAL, Camera, TemperatureRange

HERE = Path(__file__).parents[1] / "export"
SPLAT_TRANSFORM = HERE / "node_modules" / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
GLTF_TRANSFORM = HERE / "node_modules" / "@gltf-transform" / "core"
QT = {"PATH": os.environ.get("PATH", ""), "QT_QPA_PLATFORM": "offscreen", "LC_ALL": "C.UTF-8"}
"""Environment of programs with Qt: no window, and nothing of the tests' own Python."""

NPM_INSTALL = "npm install --prefix tests/export --ignore-scripts --no-package-lock"

CELSIUS = TemperatureRange(10.0, 30.0)
PLY_TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4"}


def read_ply(path: Path) -> tuple[list[str], dict[str, np.ndarray]]:
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


def splats_from(rows: np.ndarray) -> SplatArrays:
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


def splats_of(attributes: dict[str, list]) -> SplatArrays:
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


def draw(splats: SplatArrays, camera: Camera) -> torch.Tensor:
    """The colours of the splats from a camera, [H, W, 3]."""
    sh = torch.zeros(len(splats), 16, 3)
    sh[:, : splats.sh.shape[1]] = torch.from_numpy(splats.sh)
    opacities = torch.from_numpy(splats.opacities)
    means, quats, scales = (
        torch.from_numpy(array) for array in (splats.means, splats.quats, splats.scales)
    )
    return (
        BakedModel(
            means,
            quats,
            scales,
            {RGB: opacities},
            {RGB: sh[:, :1]},
            {RGB: sh[:, 1:]},
            opacities,
            None,
            dilation=Dilation(),
        )
        .render(camera)[RGB]
        .image
    )


def make_baked(count: int = 50, temperature: TemperatureRange | None = CELSIUS) -> BakedModel:
    """Random splats in a ball."""
    generator = torch.Generator().manual_seed(3)
    means = torch.randn(count, 3, generator=generator)
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=1)
    scales = torch.rand(count, 3, generator=generator) * 0.1 + 0.01
    opacities = torch.rand(count, 2, generator=generator) * 0.98 + 0.01
    sh = torch.randn(count, 16, 3, generator=generator) * 0.2
    temperatures = torch.rand(count, generator=generator)
    by_modality = {RGB: opacities[:, 0], THERMAL: opacities[:, 1]}
    return BakedModel(
        means,
        quats,
        scales,
        by_modality,
        {RGB: sh[:, :1]},
        {RGB: sh[:, 1:]},
        temperatures,
        temperature,
        dilation=Dilation(),
    )


def splat_transform(path: Path) -> SplatArrays:
    """Read any splat file with PlayCanvas's splat-transform, by way of a PLY that it writes."""
    require_node(SPLAT_TRANSFORM)
    with TemporaryDirectory() as folder:
        output = Path(folder) / f"{path.name}.read.ply"
        run_node(SPLAT_TRANSFORM, "--quiet", "--overwrite", path, output)
        return splats_from(read_ply(output)[1]["vertex"])


def read_glb(path: Path) -> dict[str, Any]:
    """Read a glb with gltf-transform and check it with Khronos's validator."""
    require_node(GLTF_TRANSFORM)
    with TemporaryDirectory() as folder:
        output = Path(folder) / "glb.json"
        run_node(HERE / "read_glb.mjs", path, output)
        return json.loads(output.read_text())


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


@cache
def qgis_python() -> str | None:
    """The Python interpreter that QGIS's library is installed for; None without one. That is the
    system's own, not that of a virtual environment."""
    found = {"/usr/bin/python3", shutil.which("python3") or "/usr/bin/python3"}
    for python in sorted(each for each in found if Path(each).is_file()):
        process = subprocess.run([python, "-c", "import qgis.core"], capture_output=True, env=QT)
        if process.returncode == 0:
            return python
    return None


def read_qgis(
    folder: Path, rasters: Mapping[Path, Sequence[Sequence[float]]], crs: Sequence[str] = ()
) -> dict[str, Any]:
    """What QGIS's library reads in maps, see ``read_qgis.py``.

    Args:
        folder: for the request.
        rasters: points (map coordinates) by the path of the map, whose values are wanted.
        crs: definitions to be understood.
    """
    python = qgis_python()
    if python is None:
        pytest.skip("QGIS's library is not installed: apt-get install python3-qgis")
    request = folder / "request.json"
    asked = [{"path": str(path), "points": [*points]} for path, points in rasters.items()]
    request.write_text(json.dumps({"rasters": asked, "crs": [*crs]}), encoding="utf-8")
    process = subprocess.run(
        [python, HERE / "read_qgis.py", request],
        capture_output=True, text=True, timeout=120, env=QT,
    )  # fmt: skip
    assert process.returncode == 0, process.stdout + process.stderr
    answer: dict[str, Any] = json.loads(process.stdout)
    return answer
