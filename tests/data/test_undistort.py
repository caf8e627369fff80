from __future__ import annotations

import numpy as np
import pytest
import torch

from mrgs.data.undistort import resize
from mrgs.scene.lens import Lens, pinhole_of, undistort

LENSES = {
    "board thermal": Lens(160, 120, 161.1, 160.8, 76.1, 65.7, (-0.40296695, 0.36920666, 0.0, 0.0)),
    "thermoscenes": Lens(
        120, 160, 89.6, 156.9, 61.0, 78.0, (0.05, -0.06, 0.0, 0.0), (-0.003, 0.062)
    ),
    "pincushion": Lens(160, 120, 150.0, 150.0, 80.0, 60.0, (0.2, 0.0, 0.0, 0.0)),
    "fisheye": Lens(160, 120, 80.0, 80.0, 80.0, 60.0, (0.01, -0.002, 0.0, 0.0), fisheye=True),
    "folding barrel": Lens(160, 120, 110.0, 110.0, 80.0, 60.0, (-0.4, 0.0, 0.0, 0.0)),
}


def pattern(x: np.ndarray, y: np.ndarray) -> torch.Tensor:
    """A smooth function of the ray (x, y, 1)."""
    return torch.from_numpy(
        np.stack([np.sin(3 * x) * np.cos(2 * y), x, y], axis=-1).astype(np.float32)
    )


def pixel_centres(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    return (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy


@pytest.mark.parametrize("name", LENSES)
def test_an_analytic_pattern_is_put_right(name):
    lens = LENSES[name]
    through_lens = pattern(*lens.undistort(*pixel_centres(lens)))
    got, valid = undistort(through_lens, None, lens)
    expected = pattern(*pixel_centres(pinhole_of(lens)))
    seen = torch.ones(got.shape[:2], dtype=torch.bool) if valid is None else valid
    # A pixel next to the fold is stretched so far that neighbours cannot be interpolated: leave the
    # rim out.
    inner = seen if name != "folding barrel" else seen & (expected[..., 1:].norm(dim=-1) < 0.75)
    error = (got - expected).abs()[inner]
    assert error.max() < 3e-3  # a shift by a tenth of a pixel would be seen
    assert inner.float().mean() > 0.9 if name != "folding barrel" else inner.any()


@pytest.mark.parametrize("name", ["board thermal", "thermoscenes", "pincushion", "fisheye"])
def test_every_pixel_is_valid_and_little_is_lost(name):
    lens = LENSES[name]
    _, valid = undistort(torch.zeros(lens.height, lens.width, 1), None, lens)
    assert valid is None
    pinhole = pinhole_of(lens)
    assert (pinhole.width, pinhole.height) == (lens.width, lens.height)
    x, y = pixel_centres(pinhole)
    u, v = lens.distort(x, y)
    u, v = lens.fx * u + lens.cx, lens.fy * v + lens.cy
    margins = [u.min(), v.min(), lens.width - u.max(), lens.height - v.max()]
    np.testing.assert_allclose(margins, 0.5, atol=0.05)  # it touches all four edges


def test_pixels_behind_the_fold_are_invalid():
    lens = LENSES["folding barrel"]
    _, valid = undistort(torch.zeros(lens.height, lens.width, 1), None, lens)
    x, y = pixel_centres(pinhole_of(lens))
    assert valid is None or not valid[np.hypot(x, y) > 1 / np.sqrt(1.2)].any()


def test_a_pinhole_is_left_alone():
    lens = Lens(8, 6, 10.0, 11.0, 4.1, 2.9)
    assert pinhole_of(lens) is lens
    values = torch.rand(6, 8, 3, generator=torch.Generator().manual_seed(0))
    assert undistort(values, None, lens) == (values, None)


def test_a_negligible_distortion_changes_next_to_nothing():
    lens = Lens(80, 60, 70.0, 75.0, 41.0, 29.0, (1e-12, 0.0, 0.0, 0.0))
    pinhole = pinhole_of(lens)
    assert (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy) == pytest.approx(
        (70.0, 75.0, 41.0, 29.0), abs=1e-6
    )
    values = torch.rand(60, 80, 1, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(undistort(values, None, lens)[0], values, atol=1e-4, rtol=0)


def test_thermal_values_are_not_quantised():
    lens = LENSES["board thermal"]
    values = torch.linspace(0.5, 0.5 + 1 / 255, 120)[:, None, None].expand(120, 160, 1)
    assert undistort(values, None, lens)[0].unique().numel() > 10_000


def test_masked_pixels_stay_masked():
    lens = LENSES["board thermal"]
    valid = torch.ones(120, 160, dtype=torch.bool)
    valid[40:60, 50:90] = False
    _, seen = undistort(torch.zeros(120, 160, 1), valid, lens)
    x, y = pixel_centres(pinhole_of(lens))
    u, v = lens.distort(x, y)
    column, row = (lens.fx * u + lens.cx).astype(int), (lens.fy * v + lens.cy).astype(int)
    assert not seen[~valid[row, column]].any()
    assert 0.9 < seen.float().mean() < 0.97


def test_a_distortion_that_cannot_be_true_is_refused():
    with pytest.raises(ValueError, match="fold the image"):
        pinhole_of(Lens(160, 120, 100.0, 100.0, 80.0, 60.0, (-100.0, 0.0, 0.0, 0.0)))


@pytest.mark.parametrize("size", [(20, 15), (37, 23), (5, 60)])
def test_resize_keeps_a_plane_in_place(size):
    """A linear ramp must keep its values at the new pixels' centres, away from the border."""
    width, height = size
    u, v = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
    ramp = torch.from_numpy((2 * u + 3 * v).astype(np.float32))[..., None]
    got, valid = resize(ramp, None, width, height)
    new_u, new_v = np.meshgrid(
        (np.arange(width) + 0.5) * 80 / width, (np.arange(height) + 0.5) * 60 / height
    )
    inner = (slice(2, -2), slice(2, -2))
    np.testing.assert_allclose(got[..., 0][inner], (2 * new_u + 3 * new_v)[inner], atol=0.6)
    assert valid is None


def test_resize_averages_fine_detail_away():
    checkers = torch.from_numpy((np.indices((60, 80)).sum(axis=0) % 2).astype(np.float32))[
        ..., None
    ]
    got, _ = resize(checkers, None, 20, 15)
    assert (got - 0.5).abs().max() < 0.02


def test_resize_keeps_invalid_pixels_out():
    valid = torch.ones(60, 80, dtype=torch.bool)
    valid[30, 40] = False
    _, reduced = resize(torch.zeros(60, 80, 1), valid, 20, 15)
    assert not reduced[7, 10]
    assert 1 <= (~reduced).sum() <= 9
