"""The real thing, on a few small photos of the bundled scene."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

from mrgs.data import load_scene
from mrgs.data.radiometric import GpsPosition
from mrgs.errors import SceneError
from mrgs.prepare.sfm.reconstruct import positions_of, reconstruct
from mrgs.scene import RGB, THERMAL
from mrgs.scene.rotations import matrix_from_rotvec

WIDE_PX = 300.0
"""Focal length of the thermal camera."""

TABLETOP = Path(__file__).parents[3] / "examples" / "tabletop"
needs_pycolmap = pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed (extra sfm)"
)


class StoppedError(Exception):
    """Ends a call as Ctrl-C does."""


def noise(path: Path, seed: int) -> Path:
    Image.fromarray(np.random.default_rng(seed).integers(0, 256, (240, 320), dtype=np.uint8)).save(
        path
    )
    return path


@needs_pycolmap
def test_poses_of_the_table_top_after_an_interruption(tmp_path):
    """Stopped after the features, continued with the matches, and the same bits as without a stop;
    one photo belongs to something else."""
    truth = {view.name: view.camera.viewmat for view in load_scene(TABLETOP).train[:6]}
    images = {name: TABLETOP / "images" / f"{name}.jpg" for name in truth}
    images["elsewhere"] = noise(tmp_path / "elsewhere.png", 1)
    steps = []

    def stop_at_matching(*step: object) -> None:
        steps.append(step)
        if step[0] == "matching":
            raise StoppedError

    with pytest.raises(StoppedError):
        reconstruct(images, tmp_path, stop_at_matching, modality=RGB)
    assert steps[-2:] == [("features", 7, 7), ("matching", 0, 21)]
    steps.clear()
    found = reconstruct(images, tmp_path, lambda *step: steps.append(step), modality=RGB)
    assert steps[0] == ("features", 7, 7)
    assert steps[-1] == ("mapping", 6, 7)
    whole = reconstruct(images, tmp_path / "whole", lambda *step: None, modality=RGB)
    assert whole.lenses == found.lenses
    assert torch.equal(whole.points.positions, found.points.positions)
    assert all(torch.equal(whole.viewmats[name], found.viewmats[name]) for name in truth)
    assert [left.name for left in found.failed] == ["elsewhere"]
    assert found.reprojection_px < 1
    assert len(found.points.positions) > 100
    assert found.lenses[next(iter(truth))].fx == pytest.approx(307.4, rel=0.05)
    first, *others = truth
    for name in others:
        own = found.viewmats[name] @ found.viewmats[first].inverse()
        true = truth[name] @ truth[first].inverse()
        angle_deg = np.degrees(np.arccos(((own[:3, :3] * true[:3, :3]).sum().item() - 1) / 2))
        assert angle_deg < 1
    sees = found.points.positions[found.visible[first]].double() @ found.viewmats[first][:3, :3].T
    assert ((sees + found.viewmats[first][:3, 3])[:, 2] > 0).all()


def test_positions_in_metres_or_none(tmp_path):
    """What the job gets of GPS: nothing unless all photos have it, no heights unless all do."""
    images = {name: tmp_path / name for name in ("a", "b")}
    here = GpsPosition(48.0, 11.0, 500.0)
    there = GpsPosition(48.0001, 11.0, 503.0)
    assert positions_of(images, {}) is None
    assert positions_of(images, {"a": here}) is None
    east, north, up = positions_of(images, {"b": there, "a": here})[1]
    assert (east, north, up) == pytest.approx((0, 11.12, 3), abs=0.01)
    flat = positions_of(images, {"a": here, "b": GpsPosition(48.0001, 11.0, None)})
    assert (flat[:, 2] == 0).all()
    assert flat[1, 1] == pytest.approx(11.12, abs=0.01)


@needs_pycolmap
def test_photos_that_share_nothing(tmp_path):
    images = {f"photo_{seed}": noise(tmp_path / f"photo_{seed}.png", seed) for seed in range(3)}
    with pytest.raises(SceneError, match=r"only 0 of 3 .*photo_0"):
        reconstruct(images, tmp_path, lambda *step: None, modality=RGB)


def test_two_photos_are_too_few(tmp_path):
    images = {f"photo_{seed}": noise(tmp_path / f"photo_{seed}.png", seed) for seed in range(2)}
    with pytest.raises(SceneError, match="3 photos at least"):
        reconstruct(images, tmp_path, lambda *step: None, modality=RGB)


def thermal_photos_of_a_corner(folder: Path, count: int) -> tuple[dict[str, Path], dict]:
    """Two walls with warm patches, by a camera that drifts by degrees and shades; and the world to
    camera rotations."""
    rng = np.random.default_rng(0)
    walls = [gaussian_filter(rng.normal(0, 1, (600, 600)), 4) for _ in range(2)]
    walls = [12 + 0.5 * wall / wall.std() for wall in walls]
    columns, rows = np.meshgrid(np.arange(320) - 159.5, np.arange(240) - 119.5)
    rays = np.stack([columns / WIDE_PX, rows / WIDE_PX, np.ones_like(rows)], axis=-1)
    files, rotations = {}, {}
    for number in range(count):
        place = np.array([-1.5 + 3 * number / count, rng.normal(0, 0.2), -4.0])
        turn = matrix_from_rotvec([0.0, 0.25 - 0.5 * number / count, 0.02])
        directions = rays @ turn
        seen, nearest = np.zeros(rows.shape), np.full(rows.shape, np.inf)
        for wall, side in zip(walls, (1, -1), strict=True):
            normal = np.array([0.5 * side, 0.0, 1.0])  # the walls meet at x = 0
            reach = -(place @ normal) / (directions @ normal)
            hits = place + reach[..., None] * directions
            texels = [(hits[..., 1] + 3) * 100, (hits[..., 0] + 3) * 100]
            here = (reach < nearest) & (side * hits[..., 0] >= 0)
            seen = np.where(here, map_coordinates(wall, texels, order=1, mode="wrap"), seen)
            nearest = np.where(here, reach, nearest)
        shading = 1.5 * (columns**2 + rows**2) / 200**2
        celsius = seen + rng.uniform(-3, 3) + shading + rng.normal(0, 0.04, rows.shape)
        files[f"{number}"] = folder / f"{number}.tiff"
        Image.fromarray(celsius.astype(np.float32)).save(files[f"{number}"])
        rotations[f"{number}"] = turn
    return files, rotations


@needs_pycolmap
def test_thermal_photos_alone_that_drift_and_shade(tmp_path):
    images, rotations = thermal_photos_of_a_corner(tmp_path, 8)
    wide_deg = float(np.degrees(2 * np.arctan(160 / WIDE_PX)))
    found = reconstruct(
        images, tmp_path, lambda *step: None, modality=THERMAL, field_of_view_deg=wide_deg
    )
    assert found.failed == ()
    assert found.lenses["0"].fx == pytest.approx(WIDE_PX, rel=1e-3)
    for name in images:
        own = (found.viewmats[name] @ found.viewmats["0"].inverse())[:3, :3].numpy()
        true = rotations[name] @ rotations["0"].T
        assert np.degrees(np.arccos((np.trace(own @ true.T) - 1) / 2)) < 1
