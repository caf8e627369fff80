from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mrgs.scene.similarity import Similarity, fit_robustly, fit_similarity


def random_similarity(rng: np.random.Generator, dimensions: int) -> Similarity:
    rotation = Rotation.random(random_state=rng).as_matrix()
    if dimensions == 2:
        rotation = Rotation.from_euler("z", rng.uniform(-3, 3)).as_matrix()[:2, :2]
    return Similarity(float(rng.uniform(0.1, 10)), rotation, rng.normal(0, 100, dimensions))


@given(seed=st.integers(0, 10_000), dimensions=st.sampled_from([2, 3]), count=st.integers(4, 40))
def test_exact_points_give_the_similarity_back(seed, dimensions, count):
    rng = np.random.default_rng(seed)
    truth, source = random_similarity(rng, dimensions), rng.normal(0, 3, (count, dimensions))
    fit = fit_robustly(source, truth(source))
    assert fit.similarity.scale == pytest.approx(truth.scale)
    assert fit.similarity.rotation == pytest.approx(truth.rotation, abs=1e-6)
    assert fit.similarity(source) == pytest.approx(truth(source), abs=1e-6)
    assert fit.inliers.all()


@given(seed=st.integers(0, 10_000))
def test_outliers_are_found_and_change_nothing(seed):
    rng = np.random.default_rng(seed)
    truth, source = random_similarity(rng, 3), rng.normal(0, 3, (30, 3))
    target = truth(source) + rng.normal(0, 0.01 * truth.scale, (30, 3))
    target[:10] += rng.uniform(5, 50, (10, 3)) * truth.scale
    fit = fit_robustly(source, target)
    assert not fit.inliers[:10].any()
    assert fit.inliers[10:].sum() >= 18
    assert fit.similarity.scale == pytest.approx(truth.scale, rel=0.02)
    assert fit.sigma == pytest.approx(0.01 * truth.scale, rel=0.5)


def test_mirrored_points_are_not_fitted_by_a_reflection():
    source = np.random.default_rng(0).normal(0, 1, (10, 3))
    assert np.linalg.det(fit_similarity(source, source * [1, 1, -1]).rotation) == pytest.approx(1)
