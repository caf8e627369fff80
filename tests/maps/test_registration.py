"""The similarity between pairs of points, most of which may be wrong."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mrgs.data.earth import geodetic
from mrgs.maps.registration import (
    FEWEST_MATCHES,
    GPS_M,
    _Features,
    _fitted,
    _pairs,
    _shift_by_gps,
    require_pycolmap,
)
from mrgs.scene import EarthPosition, WorldFrame

COUNT = 600


def pairs(seed: int, right: float) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Pairs of points, of which a share belongs together up to noise; scale and rotation."""
    rng = np.random.default_rng(seed)
    source = rng.uniform(-3, 3, (COUNT, 3))
    scale, turn = float(rng.uniform(0.3, 3)), Rotation.random(random_state=seed).as_matrix()
    target = scale * source @ turn.T + rng.uniform(-5, 5, 3)
    target += rng.normal(0, 0.01 * scale, target.shape)
    wrong = rng.random(COUNT) > right
    target[wrong] = target[rng.permutation(np.flatnonzero(wrong))]
    return source, target, scale, turn


@given(seed=st.integers(0, 1000), right=st.floats(0.3, 1.0))
def test_it_is_found_among_wrong_pairs(seed, right):
    source, target, scale, turn = pairs(seed, right)
    found = _fitted(require_pycolmap(), source, target, 0.08 * scale)
    assert found is not None
    assert found.scale == pytest.approx(scale, rel=0.01)
    np.testing.assert_allclose(found.rotation, turn, atol=0.01)
    assert found.matches >= 0.9 * right * COUNT - 30
    assert 0 < found.residual < 0.03


@pytest.mark.parametrize("seed", range(3))
def test_chance_is_no_alignment(seed):
    source, target, scale, _ = pairs(seed, 0.0)
    assert _fitted(require_pycolmap(), source, target, 0.08 * scale) is None


def test_few_pairs_are_no_alignment():
    source, target, scale, _ = pairs(0, 1.0)
    few = slice(FEWEST_MATCHES - 1)
    assert _fitted(require_pycolmap(), source[few], target[few], 0.08 * scale) is None


def test_pairs_that_have_no_similarity_are_no_alignment():
    source, target, scale, _ = pairs(0, 1.0)
    pycolmap = require_pycolmap()
    without = SimpleNamespace(
        RANSACOptions=pycolmap.RANSACOptions,
        estimate_sim3d_robust=pycolmap.estimate_sim3d_robust,
        estimate_sim3d=lambda source, target: None,
    )
    assert _fitted(without, source, target, 0.08 * scale) is None


def test_features_are_matched_where_they_are_alike():
    rng = np.random.default_rng(0)
    features = rng.normal(0, 1, (40, 128)).astype(np.float32)
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    places, order = rng.uniform(0, 1, (40, 3)), rng.permutation(40)
    twins = features[order].copy()
    twins[0] = twins[1]  # two that are alike match nothing
    twins += rng.normal(0, 0.005, twins.shape).astype(np.float32)
    twins /= np.linalg.norm(twins, axis=1, keepdims=True)
    source, target = _pairs(
        [_Features(features, places)], [_Features(twins, 10 + places[order]), _Features(
            np.empty((0, 128), np.float32), np.empty((0, 3)))]
    )  # fmt: skip
    assert len(source) == 38
    np.testing.assert_allclose(target, 10 + source)


def test_where_gps_tells_the_place_what_looks_alike_elsewhere_is_no_pair():
    rng = np.random.default_rng(3)
    features = rng.normal(0, 1, (60, 128)).astype(np.float32)
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    places = rng.uniform(0, 5, (60, 3))
    here, there = (
        _Features(features, places),
        _Features(features, places + np.array([GPS_M + 6, 0, 0])),
    )
    assert len(_pairs([here], [here, there])[0]) == 120
    moved, shift = np.array([2.0, -1.0, 0.0]), np.array([2.0, -1.0, 40.0])  # by barometer
    after = [each._replace(points=each.points + moved) for each in (here, there)]
    source, target = _pairs([here], after, shift)
    assert len(source) == 60
    np.testing.assert_allclose(target, source + moved)


def test_gps_tells_where_one_scene_is_in_the_other():
    def scene_of(origin):
        return SimpleNamespace(world=WorldFrame(True, origin is not None, origin))

    here = EarthPosition(48.137, 11.575, 520.0)
    east = geodetic(np.array([30.0, 0.0, 2.0]), here)
    first, second = scene_of(here), scene_of(east)
    np.testing.assert_allclose(_shift_by_gps(first, second), [-30.0, 0.0, -2.0], atol=1e-3)
    assert _shift_by_gps(first, scene_of(None)) is None
