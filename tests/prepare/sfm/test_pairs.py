from __future__ import annotations

import numpy as np
import pytest

from mrgs.prepare.sfm.pairs import (
    ALIKE,
    MAX_EXHAUSTIVE,
    NEIGHBOURS,
    image_signatures,
    pairs_nearby,
    pairs_to_match,
)


def around_a_place(place: int, seed: int) -> np.ndarray:
    """Descriptors of an image of one of several places, which have nothing in common."""
    things = np.random.default_rng(place).integers(0, 256, (40, 128))
    noise = np.random.default_rng(seed).integers(-10, 11, things.shape)
    return np.clip(things + noise, 0, 255).astype(np.uint8)


def test_a_small_set_is_matched_with_all():
    def unread():
        raise AssertionError("descriptors are not needed")

    assert pairs_to_match(4, unread) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]


def test_a_large_set_is_matched_with_neighbours_and_with_what_is_alike():
    """A walk past places 0, 1, …, 15, and then past the same places again."""
    count = MAX_EXHAUSTIVE + 60
    descriptors = [around_a_place(image % 80 // 5, image) for image in range(count)]
    pairs = pairs_to_match(count, lambda: descriptors)
    assert all(first < second for first, second in pairs)
    assert len(pairs) == len(set(pairs)) <= count * (NEIGHBOURS + ALIKE)
    assert {(0, 1), (0, NEIGHBOURS), (count - 2, count - 1)} <= set(pairs)
    closed = sum((image, image + 80) in pairs for image in range(80))
    assert closed == 80


def test_a_large_set_with_gps_is_matched_with_what_was_taken_nearby():
    def unread():
        raise AssertionError("descriptors are not needed")

    positions = np.array(
        [[4.0 * along, 3.5 * line, 20] for line in range(12) for along in range(12)]
    )
    assert pairs_to_match(len(positions), unread, positions) == pairs_nearby(positions)


def test_gps_does_not_count_where_all_stand_close_together():
    count = MAX_EXHAUSTIVE + 60
    descriptors = [around_a_place(image % 80 // 5, image) for image in range(count)]
    positions = np.random.default_rng(0).normal(0, 1.0, (count, 3))
    pairs = pairs_to_match(count, lambda: descriptors, positions)
    assert pairs == pairs_to_match(count, lambda: descriptors)


def test_images_of_one_place_are_alike():
    descriptors = [around_a_place(place, seed) for seed, place in enumerate([0, 1, 2, 0, 1, 2])]
    signatures = image_signatures(descriptors)
    likeness = signatures @ signatures.T
    assert np.diag(likeness) == pytest.approx(1, abs=1e-5)
    np.fill_diagonal(likeness, -1)
    assert likeness.argmax(axis=1).tolist() == [3, 4, 5, 0, 1, 2]


def test_images_without_features_are_like_none():
    empty = np.zeros((0, 128), dtype=np.uint8)
    assert (image_signatures([around_a_place(0, 0), empty])[1] == 0).all()
    assert image_signatures([empty, empty]).shape == (2, 1)
