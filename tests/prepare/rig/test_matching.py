from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from mrgs.prepare.rig.images import structure
from mrgs.prepare.rig.refine import Masked, Patches, match, whole_displacement

PATCHES = Patches(sigma=12, spacing=12, reach=4)
IMAGE = gaussian_filter(np.random.default_rng(3).uniform(size=(120, 160)), 3.0)
SEEN = np.ones(IMAGE.shape, dtype=bool)


@pytest.mark.parametrize(("right", "down"), [(0.0, 0.0), (2.3, -1.6), (-3.0, 0.7)])
def test_a_shifted_and_inverted_image_is_found_to_a_tenth_of_a_pixel(right, down):
    moved = -shift(IMAGE, (down, right), order=3, mode="reflect")
    found = match(Masked(structure(moved, 2.0)), Masked(structure(IMAGE, 2.0)), PATCHES)
    assert len(found.scores) > 60
    inner = np.all((found.centres > 30) & (found.centres < (130, 90)), axis=1)
    np.testing.assert_allclose(
        np.median(found.displacements[inner], axis=0), (right, down), atol=0.1
    )
    assert found.scores[inner].min() > 0.9


def test_information_lies_across_an_edge():
    step = gaussian_filter(np.where(np.arange(160) > 80, 1.0, 0.0)[None].repeat(120, axis=0), 1.0)
    noise = np.random.default_rng(0).normal(0, 0.02, (2, *step.shape))
    found = match(
        Masked(structure(step + noise[0], 2.0)), Masked(structure(step + noise[1], 2.0)), PATCHES
    )
    at_edge = np.abs(found.centres[:, 0] - 80) < 8
    assert at_edge.any()
    across, along = found.information[at_edge, 0, 0], found.information[at_edge, 1, 1]
    assert np.median(across / along) > 3


def test_what_is_not_seen_and_what_is_out_of_reach_is_left_out():
    seen = SEEN.copy()
    seen[:, 80:] = False
    found = match(Masked(structure(IMAGE, 2.0)), Masked(structure(IMAGE, 2.0), seen), PATCHES)
    assert found.centres[:, 0].max() < 80
    far = shift(IMAGE, (0, 12), order=1, mode="reflect")
    lost = match(Masked(structure(far, 2.0)), Masked(structure(IMAGE, 2.0)), PATCHES)
    assert len(lost.scores) < 0.5 * len(found.scores) + 20
    flat = structure(np.zeros(IMAGE.shape), 2.0)
    assert len(match(Masked(flat), Masked(structure(IMAGE, 2.0)), PATCHES).scores) == 0


def test_overlapping_windows_count_for_less():
    assert Patches(sigma=16, spacing=16, reach=4).independent == pytest.approx(1 / (4 * np.pi))
    assert Patches(sigma=1, spacing=100, reach=4).independent == 1.0


@pytest.mark.parametrize(("right", "down"), [(0, 0), (12, -6), (-16, 10)])
def test_the_displacement_of_a_whole_image(right, down):
    large = gaussian_filter(np.random.default_rng(4).uniform(size=(160, 200)), 3.0)
    moved = -large[20 - down : 140 - down, 20 - right : 180 - right]
    found = whole_displacement(
        Masked(structure(moved, 1.5)), Masked(structure(large[20:140, 20:180], 1.5)), reach=16
    )
    assert found == (right, down)
