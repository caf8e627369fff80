"""The real thing, on a few small photos of the bundled scene."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mrgs.data import load_scene
from mrgs.data.radiometric import GpsPosition
from mrgs.errors import SceneError
from mrgs.prepare.sfm.reconstruct import positions_of, reconstruct
from mrgs.scene import RGB

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
    """Stopped after the features, continued with the matches; one photo belongs to something
    else."""
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
