"""Where one run's coordinates are in those of another run of the same object.

Features of the photos of both dates are matched (SIFT, Lowe 2004). With the depths of the models
each match is a pair of points in space, and the similarity between all pairs is found by random
sample consensus with local optimisation (LO-RANSAC) around Umeyama's least squares (1991); both by
pycolmap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Float32, Float64

from mrgs.data.earth import enu
from mrgs.errors import RunError
from mrgs.maps.surfaces import median_distance
from mrgs.pictures.files import to_array
from mrgs.runs.open import Run
from mrgs.scene import Scene
from mrgs.scene.depth_map import MAX_STEP, DepthMap, surveying, visible
from mrgs.scene.similarity import Similarity
from mrgs.system.lazy import optional_package

Points: TypeAlias = Float64[np.ndarray, "n 3"]

PHOTOS, WIDEST_PX, MOST_FEATURES = 24, 800, 1500
"""Photos of the first date whose features are matched with those of as many of the second or, if
these do not show all of it, more; their width, and the features of one."""

RATIO = 0.85
"""A match is kept if no second feature is nearly as similar: distances below this ratio."""

FEWEST_OF_PAIR = 6
"""Two photos with fewer matches are taken for photos of different places."""

TOLERANCE = 0.02
"""Largest distance of a pair of points after registration, as a share of the median depth."""

FEWEST_MATCHES, LEAST_SHARE = 100, 0.12
"""Fewer pairs that agree, or a smaller share of all, are not a registration: of photos of different
generated objects chance made at most 5 % agree, and of one façade 68 % did."""

LEAST_AGREEMENT = 0.6
"""Share of the surface that both dates' photos look at on which the models must coincide."""

LEAST_OVERLAP = 0.05
"""Share of the first date's surface that the second date must show."""

MOST_METRES = 0.1
"""If both runs are in metres these may differ by this share."""

GPS_M = 10.0
"""The GPS of two dates may contradict each other by so much, east and north, metres."""

require_pycolmap = partial(optional_package, "pycolmap", "comparisons of two dates", "sfm")


@dataclass(frozen=True, eq=False)
class Registration(Similarity):
    """The similarity from the first run's coordinates to the second's.

    Attributes:
        matches: pairs of points that agree with it.
        residual: their median distance, in the first run's scene units.
        overlap: share of the surface seen in the first run that the second one's photos show.
    """

    matches: int = 0
    residual: float = 0.0
    overlap: float = 1.0


class _Features(NamedTuple):
    """Descriptors of a photo's features, and where on the model's surface they are."""

    descriptors: Float32[np.ndarray, "n 128"]
    points: Points


def register(first: Run, second: Run, scenes: tuple[Scene, Scene]) -> Registration:
    """The similarity between two runs of one object; ``scenes`` are theirs. ConfigError if pycolmap
    is not installed, RunError if the runs do not overlap, or not enough of the photos' features
    agree on one similarity; SceneError if a photo cannot be read."""
    pycolmap = require_pycolmap()
    pycolmap.logging.minloglevel = int(pycolmap.logging.WARNING)
    extractor = _extractor(pycolmap)
    before, maps = _features(first, scenes[0], extractor, 0)
    after, others = _features(second, scenes[1], extractor, 1)
    source, target = _pairs(before, after, _shift_by_gps(*scenes))
    fitted = _fitted(pycolmap, source, target, TOLERANCE * median_distance(others))
    if fitted is None:
        raise RunError(
            f"{first.folder.path} and {second.folder.path} cannot be aligned: too few features of "
            f"their photos agree on one alignment; are they of the same object, and from similar "
            f"sides?"
        )
    points = np.concatenate([each.points()[:: len(maps)] for each in maps])
    overlap, agreement = _coincidence(others, fitted(points).astype(np.float32))
    if overlap < LEAST_OVERLAP or agreement < LEAST_AGREEMENT:
        raise RunError(
            f"{first.folder.path} and {second.folder.path} cannot be aligned: their surfaces "
            f"coincide on {100 * agreement:.0f} % of what both show, and {100 * overlap:.0f} % of "
            f"the first"
        )
    if all(scene.world.metric for scene in scenes) and abs(fitted.scale - 1) > MOST_METRES:
        raise RunError(
            f"a metre of {first.folder.path} is {fitted.scale:.2f} m in {second.folder.path}: "
            f"check the known distance or GPS of both scenes"
        )
    return replace(fitted, overlap=overlap)


def _extractor(pycolmap: Any) -> Any:
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.sift.max_num_features = MOST_FEATURES
    options.sift.peak_threshold /= 2
    return pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)


def _features(
    run: Run, scene: Scene, extractor: Any, enough: int
) -> tuple[list[_Features], list[DepthMap]]:
    """Features of photos of the scene's first modality, of which ``enough`` show each place, and
    their depth maps."""
    modality = scene.modalities[0]
    photos = scene.train_photos(modality)
    features, maps = [], []
    cameras, places = [photo.camera for photo in photos], scene.points.positions.numpy()
    for index in surveying(cameras, places, PHOTOS, enough):
        camera = photos[index].camera.at_most(WIDEST_PX)
        image = photos[index].look(camera.width).values.mean(dim=2)[None, None]
        size = camera.height, camera.width
        grey = torch.nn.functional.interpolate(image, size, mode="area")[0, 0].numpy()
        keypoints, described = extractor.extract_from_float32_array(np.ascontiguousarray(grey))
        found = np.array([(each.x, each.y) for each in keypoints]).reshape(-1, 2)
        descriptors = described.data.astype(np.float32)
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        surface = run.render({modality: camera}).surface_depth(modality, max_step=MAX_STEP)
        depth = to_array(scene.reach.without_background(camera, surface))
        column, row = np.minimum(found.astype(int), (size[1] - 1, size[0] - 1)).T
        pixels = torch.from_numpy(found)
        z = torch.from_numpy(depth[row, column].astype(np.float64))
        points = camera.unproject(pixels, z).numpy()
        known = np.isfinite(points).all(axis=1)
        features.append(_Features(descriptors[known], points[known]))
        maps.append(DepthMap(camera, depth, np.empty((*size, 0), np.float32)))
    return features, maps


def _shift_by_gps(first: Scene, second: Scene) -> Float64[np.ndarray, "3"] | None:
    """From the first scene's coordinates to the second's, metres east, north and up; None where
    GPS does not tell."""
    worlds = first.world, second.world
    origin, other = (each.origin if each.is_georeferenced else None for each in worlds)
    return None if origin is None or other is None else enu([origin], other)[0]


def _pairs(
    before: Sequence[_Features],
    after: Sequence[_Features],
    shift: Float64[np.ndarray, "3"] | None = None,
) -> tuple[Points, Points]:
    """Points of the first run and of the second whose features match each other best; where the
    ``shift`` by GPS is known, of one place: modules of a plant look alike everywhere."""
    sources, targets = [np.empty((0, 3))], [np.empty((0, 3))]
    for one in before:
        for other in after:
            if min(len(one.points), len(other.points)) < 2:
                continue
            similar = one.descriptors @ other.descriptors.T
            nearest = similar.argmax(axis=1)
            rows = np.arange(len(similar))
            mutual = similar.argmax(axis=0)[nearest] == rows
            best = similar[rows, nearest]
            similar[rows, nearest] = -np.inf
            # Distances of unit vectors: |a − b|² = 2 − 2 a·b.
            clear = 2 - 2 * best < RATIO**2 * (2 - 2 * similar.max(axis=1))
            kept = mutual & clear
            if shift is not None:
                away = other.points[nearest] - one.points - shift
                kept &= np.linalg.norm(away[:, :2], axis=1) < GPS_M
            if kept.sum() >= FEWEST_OF_PAIR:
                sources.append(one.points[kept])
                targets.append(other.points[nearest[kept]])
    return np.concatenate(sources), np.concatenate(targets)


def _fitted(pycolmap: Any, source: Points, target: Points, tolerance: float) -> Registration | None:
    """The similarity on which most pairs agree; None if too few do."""
    if len(source) < FEWEST_MATCHES:
        return None
    options = pycolmap.RANSACOptions()
    options.max_error, options.min_inlier_ratio, options.random_seed = tolerance, LEAST_SHARE, 0
    options.max_num_trials = 20_000
    robust = pycolmap.estimate_sim3d_robust(source, target, options)
    found = None if robust is None else robust["tgt_from_src"]
    for _ in range(REFITS):
        if found is None:
            return None
        distance = np.linalg.norm(_registration(found)(source) - target, axis=1)
        inliers = distance < tolerance
        if inliers.sum() < max(FEWEST_MATCHES, LEAST_SHARE * len(source)):
            return None
        limit = TIMES_MEDIAN * np.median(distance[inliers])
        near = distance <= max(limit, np.partition(distance, FEWEST_NEAR)[FEWEST_NEAR])
        found = pycolmap.estimate_sim3d(source[near], target[near])
    if found is None:
        return None
    fitted = _registration(found)
    residual = float(np.median(distance[inliers])) / fitted.scale
    return replace(fitted, matches=int(inliers.sum()), residual=residual)


REFITS, TIMES_MEDIAN, FEWEST_NEAR = 20, 0.5, 50
"""Least squares are repeated with the pairs nearer than this multiple of the median distance, or
with so many: most pairs are off by an error of a depth, and the others lie close."""


def _registration(found: Any) -> Registration:
    return Registration(float(found.scale), found.rotation.matrix(), np.asarray(found.translation))


def _coincidence(
    maps: Sequence[DepthMap], points: Float32[np.ndarray, "n 3"]
) -> tuple[float, float]:
    """Share of the points that lie on a surface in depth maps, and the same share of those that
    any of them has in its image, not behind a surface."""
    on, before = np.zeros(len(points), bool), np.zeros(len(points), bool)
    for item in maps:
        on[item.shown(points).rows] = True
        rows, pixels, z = visible(item.camera, points)
        before[rows[item.depth[pixels] > z]] = True
    return float(on.mean()), float(on.sum() / max((on | before).sum(), 1))
