from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from mrgs.errors import SceneError
from mrgs.prepare.sfm.working_folder import CLIP, local_contrast, span_of, stretched


def save(path, celsius: np.ndarray):
    Image.fromarray(celsius.astype(np.float32)).save(path)
    return path


def faint_squares(height: int = 96, width: int = 128) -> np.ndarray:
    """Squares that differ by little, and a corner that is far hotter."""
    rows, columns = np.indices((height, width))
    values = 20 + 0.5 * ((rows // 12 + columns // 12) % 2)
    values[:20, :20] = 80
    return values


def test_faint_edges_become_strong(tmp_path):
    file = save(tmp_path / "a.tiff", faint_squares())
    image = stretched(file, (20.0, 80.0)).astype(float)
    plain = 255 * (faint_squares() - 20) / 60
    assert plain[50:80, 50:110].std() < 1.5
    assert image[50:80, 50:110].std() > 4 * plain[50:80, 50:110].std()


def test_one_span_for_the_set(tmp_path):
    files = [
        save(tmp_path / f"{low}.tiff", np.linspace(low, low + 10, 400).reshape(20, 20))
        for low in (0, 20)
    ]
    assert span_of(files) == pytest.approx((0.2, 29.8), abs=0.2)


def test_pixels_without_temperature_do_not_widen_the_span(tmp_path):
    values = np.linspace(10, 20, 400).reshape(20, 20)
    values[3:5] = np.nan
    file = save(tmp_path / "a.tiff", values)
    low, high = span_of([file])
    assert 10 <= low < high <= 20
    assert stretched(file, (low, high)).shape == (20, 20)


def test_images_of_one_value_are_refused(tmp_path):
    with pytest.raises(SceneError, match="same value everywhere"):
        span_of([save(tmp_path / "a.tiff", np.full((20, 20), 7.0))])


@given(seed=st.integers(0, 1000), height=st.integers(4, 60), width=st.integers(4, 60))
def test_local_contrast_stays_in_range_and_keeps_the_order_within_a_tile(seed, height, width):
    shares = np.random.default_rng(seed).uniform(0, 1, (height, width)).astype(np.float32)
    result = local_contrast(shares)
    assert result.shape == shares.shape
    assert result.min() >= 0
    assert result.max() <= 1 + 1e-5


def test_local_contrast_of_one_tile_is_monotonic():
    shares = np.sort(np.random.default_rng(0).uniform(0, 1, 4096).astype(np.float32)).reshape(
        64, 64
    )
    one_column = local_contrast(shares)[:, 32]
    assert (np.diff(one_column.reshape(8, 8)[0]) >= -1e-6).all()


def test_the_noise_of_a_flat_surface_is_amplified_by_no_more_than_the_limit():
    noise = np.random.default_rng(0).normal(0.5, 0.002, (128, 128)).astype(np.float32)
    assert local_contrast(noise).std() <= 1.5 * CLIP * noise.std()
