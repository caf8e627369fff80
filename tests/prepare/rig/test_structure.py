from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from mrgs.prepare.rig.images import DIRECTIONS, structure

IMAGE = gaussian_filter(np.random.default_rng(0).uniform(size=(60, 80)), 2.0)


@given(st.floats(0.1, 1000), st.floats(-300, 300), st.booleans())
@settings(max_examples=15, deadline=None)
def test_scale_shift_and_sign_of_the_values_do_not_matter(scale, shift, inverted):
    changed = structure((-scale if inverted else scale) * IMAGE + shift, 1.5)
    np.testing.assert_allclose(changed, structure(IMAGE, 1.5), atol=5e-3)


def test_channels_follow_the_direction_of_edges():
    step = np.zeros((60, 60))
    step[:, 30:] = 1.0
    upright, lying = structure(step, 1.5)[:, 30, 30], structure(step.T, 1.5)[:, 30, 30]
    assert upright.argmax() == 0
    assert lying.argmax() == DIRECTIONS // 2


def test_nothing_shows_where_pixels_do_not_count():
    valid = np.ones(IMAGE.shape, dtype=bool)
    valid[:, 40:] = False
    found = structure(IMAGE, 1.5, valid)
    changed = IMAGE.copy()
    changed[:, 40:] = 99.0
    np.testing.assert_allclose(structure(changed, 1.5, valid), found, atol=1e-6)
    inside = np.abs(found[:, 10:50, 10:35]).mean()
    assert np.abs(found[:, 10:50, 60:]).mean() < 0.05 * inside


def test_a_flat_image_has_none():
    assert not structure(np.full((40, 40), 21.5), 1.5).any()
