"""Large models are written in pieces; small ones here, in pieces of a few splats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from mrgs.data.ply import write_ply
from mrgs.errors import RunError
from mrgs.export.ply import write_combined_ply, write_splat_ply
from mrgs.export.splats import require_exportable, shaded_splats
from mrgs.export.spz import write_spz
from mrgs.scene import RGB, Camera
from mrgs.scene.depth_map import visible
from mrgs.system import memory
from tests.helpers.exports import make_baked


@pytest.fixture
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "CHUNK_ROWS", 7)


def files(folder: Path) -> dict[str, bytes]:
    """The contents of all formats that are written in pieces."""
    baked = make_baked()
    faces = np.arange(60, dtype=np.int32).reshape(20, 3)
    columns = {"x": np.linspace(0, 1, 50, dtype=np.float32), "red": np.arange(50, dtype=np.uint8)}
    rgb = shaded_splats(baked, RGB)
    paths = (
        write_splat_ply(folder / "rgb.ply", rgb),
        write_combined_ply(folder / "both.ply", rgb, baked),
        write_ply(folder / "mesh.ply", {"vertex": columns, "face": faces}),
        write_spz(folder / "rgb.spz", rgb),
    )
    return {path.name: path.read_bytes() for path in paths}


def test_pieces_give_the_same_bytes(tmp_path, request):
    whole = files(tmp_path)
    request.getfixturevalue("small_pieces")
    assert files(tmp_path) == whole


def test_colours_in_pieces_are_the_same(request):
    baked, position = make_baked(), torch.tensor([3.0, 1.0, 0.5])
    whole = baked.values(RGB, position)
    request.getfixturevalue("small_pieces")
    assert torch.equal(baked.values(RGB, position), whole)


def test_broken_splats_are_counted_over_all_pieces(small_pieces):
    baked = make_baked()
    baked.means[[0, 8, 49]] = torch.nan
    baked.temperatures[8] = torch.inf
    with pytest.raises(RunError, match="3 of 50"):
        require_exportable(baked)


def test_points_in_an_image_are_found_over_all_pieces(small_pieces):
    points = make_baked().means.numpy() + np.array([0, 0, 3], np.float32)
    K = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(K, torch.eye(4, dtype=torch.float64), 64, 48)
    found = visible(camera, points)
    pixels, depth = camera.project(torch.from_numpy(points))
    inside = camera.contains(pixels).numpy()
    assert 7 < inside.sum() < 50
    np.testing.assert_array_equal(found.rows, np.flatnonzero(inside))
    np.testing.assert_array_equal(found.pixels, pixels.numpy()[inside].T[::-1].astype(int))
    np.testing.assert_array_equal(found.z, depth.numpy()[inside])
    assert len(visible(camera, points[:0]).rows) == 0
