"""Offsets and shading of the thermal photos before training, from the points that several photos
show: S(point) + offset(photo) + shading(place in the image). Offsets and shading sum to zero."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import starmap
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from torch import Tensor

from mrgs.data.images import probe
from mrgs.data.radiometric import Overrides, read_thermal_photo
from mrgs.errors import ConfigError, warn_user
from mrgs.method.camera_model.image_model import ImageModel, ImageModelConfig
from mrgs.method.camera_model.photo_shading import HEIGHT, TERMS, image_places, shading_terms
from mrgs.method.start.start_points import SAMPLING_PX, framed_points
from mrgs.scene import THERMAL, Blend, Pixels, PosedImage, Rendering, Scene, View

MOST_POINTS, MOST_SIGHTINGS = 20_000, 300_000
FEWEST_PHOTOS = 3
"""A point that fewer photos show does not tell which of them is off."""

SMOOTHED_PX = 2.0
"""Standard deviation of the Gaussian that photos are smoothed by: points are not more exact."""

EVEN_SHARE = 0.25
"""Share of the sightings that are taken for even: where more changes about a point, it counts less.
What is smeared over an edge depends on the viewpoint, and so does where the point is in the photo,
which looks like a shading."""

OFFSET_C, SHADING_C, NOT_MODELLED_C = 3.0, 1.0, 1e-4
"""Standard deviations a priori: offsets, coefficients of the shading, what is not modelled."""

DRIFT_C = 0.5
"""Standard deviation a priori of the difference between two photos a minute apart; it grows with
the root of the time. A shutter correction may make it larger."""

LEAST_ERROR_C = 0.02
"""What is found is not trusted to be better than this."""

ALIKE = 25.0
"""Sightings per independent observation: errors of neighbouring points are correlated."""

MOST_PAIRS, FEWEST_SHARED = 30, 40
"""Largest number of photos that a photo is compared with, those sharing most points first; and the
fewest shared points that count."""

ITERATIONS, CONVERGED_C = 30, 1e-3

CONTRADICTION_C = 0.3
"""A flat field contradicts the photos' overlap where the shading differs by more, RMS."""


def find_from_overlap(scene: Scene, image_model: ImageModel, config: ImageModelConfig) -> None:
    """Start the drift and the shading of an image model, as far as it has them, from where the
    scene's photos overlap; the shading from a flat field if it is configured. ConfigError if that
    cannot be used, SceneError if a photo cannot be read."""
    drift, shading = image_model.thermal_drift, image_model.thermal_shading
    flat_field = config.flat_field
    if flat_field is not None and shading is None:
        raise ConfigError(
            "a flat field corrects temperatures, and the scene's photos have no °C: leave it out",
            options=("flat_field",),
        )
    if (drift is None and shading is None) or scene.temperature is None:
        return
    photos, span_c = scene.train_photos(THERMAL), scene.temperature.span_c
    count, is_learned = len(photos), shading is not None and flat_field is None
    seen = _sightings(scene, photos)
    priors = np.full(count + TERMS, SHADING_C if shading is not None else NOT_MODELLED_C)
    priors[:count] = NOT_MODELLED_C if drift is None else OFFSET_C
    minutes = np.full(count, np.nan) if drift is None else drift.minutes
    if shading is not None and flat_field is not None:
        shading.begin(_of_flat_field(Path(flat_field), config.flat_field_unit, photos[0]) / span_c)
        known = shading.coefficients.double().numpy() * span_c
        seen = replace(seen, value=seen.value - seen.terms @ known)
        _warn_of_contradiction(_fitted(seen, priors, minutes)[0][count:])
        priors[count:] = NOT_MODELLED_C
    found, covariance = _fitted(seen, priors, minutes)
    covariance += LEAST_ERROR_C**2 * np.eye(len(covariance))
    offsets, coefficients = torch.from_numpy(found / span_c).split([count, TERMS])
    if drift is not None:
        precisions = span_c**2 / covariance.diagonal()[:count]
        drift.begin(offsets, torch.from_numpy(precisions))
    if shading is not None and is_learned:
        precision = span_c**2 * np.linalg.inv(covariance[count:, count:])
        shading.begin(coefficients, torch.from_numpy(precision))


def _warn_of_contradiction(left_c: Float[np.ndarray, "6"]) -> None:
    """Warn where the overlap asks for more shading than the flat field has."""
    left = torch.from_numpy(left_c)
    apart_c = float((shading_terms(*image_places(24, 32, left)) @ left).std())
    if apart_c > CONTRADICTION_C:
        warn_user(
            f"the flat field differs by {apart_c:.1f} °C (RMS) from the shading that shows where "
            f"the photos overlap: the camera shades as on another day, or through another lens. "
            f"Without a flat field the shading is taken from the overlap"
        )


def without_camera(scene: Scene, image_model: ImageModel) -> Scene:
    """The scene, its thermal training photos without an image model's offsets and shading."""
    if image_model.thermal_drift is None and image_model.thermal_shading is None:
        return scene

    def corrected(number: int, view: View) -> View:
        if THERMAL not in view.images:
            return view
        image = view.images[THERMAL]

        def look(width: int | None = None) -> Pixels:
            pixels = image.load() if width is None else image.look(width)
            nothing = Rendering({THERMAL: Blend.of_image(torch.zeros_like(pixels.values))})
            added = image_model(nothing, torch.tensor([number]))[THERMAL].image.detach()
            return replace(pixels, values=pixels.values - added)

        changed = replace(image, load=look, load_at_least=look)
        return View(view.name, {**view.images, THERMAL: changed})

    return replace(scene, train=tuple(starmap(corrected, enumerate(scene.train))))


def _of_flat_field(folder: Path, unit: str | None, photo: PosedImage) -> Float[Tensor, "6"]:
    """The coefficients of the shading in the photos of a folder, °C; ``photo`` is the scene's."""

    def refused(problem: str) -> ConfigError:
        return ConfigError(problem, options=("flat_field",))

    try:
        overrides = Overrides(unit=unit)
    except ConfigError as error:
        raise ConfigError(str(error), options=("flat_field_unit",)) from None
    files = sorted(path for path in folder.glob("[!.]*") if path.is_file())
    if not files:
        raise refused(f"{folder} holds no photos: name a folder of photos of a uniform target")
    own = probe(photo.files[0]) if photo.files else photo.camera
    frames, known_units = [], {None, "celsius"}
    for path in files:
        read = read_thermal_photo(path, overrides)
        celsius, guess = read.temperature_c, read.facts.unit
        if guess not in known_units:
            known_units.add(guess)
            warn_user(f"the numbers in {path} are taken for {guess}, which the file does not say")
        if celsius is None:
            raise refused(f"{path} has no °C: take radiometric photos of the target")
        height, width = celsius.shape
        if (width, height) != (own.width, own.height):
            raise refused(
                f"{path} is {width}×{height} px, but the scene's thermal photos are "
                f"{own.width}×{own.height} px: take the flat field with the same camera"
            )
        frames.append(celsius - np.nanmedian(celsius))
    mean = torch.from_numpy(np.nanmean(frames, axis=0)).double()
    known = mean.isfinite()
    x, y = image_places(own.height, own.width, mean)
    terms = torch.nn.functional.pad(shading_terms(x, y), (0, 1), value=1.0)
    return torch.linalg.lstsq(terms[known], mean[known]).solution[:-1]


@dataclass(frozen=True, eq=False)
class _Sightings:
    """Points in photos: both by number from 0, their value in °C, the shading's terms, and weights
    from 0 to 1, smaller where the photo is not even."""

    photo: Int[np.ndarray, " n"]
    point: Int[np.ndarray, " n"]
    value: Float[np.ndarray, " n"]
    terms: Float[np.ndarray, "n 6"]
    weight: Float[np.ndarray, " n"]


def _sightings(scene: Scene, photos: list[PosedImage]) -> _Sightings:
    """What the photos show of the scene's points; nothing of points that were drawn."""
    positions = scene.points.positions.double()[: 0 if scene.points.random else None]
    positions = positions[:: max(1, -(-len(positions) // MOST_POINTS))]
    found = [_seen(photo, positions) for photo in photos]
    photo = np.concatenate([np.full(len(rows), n) for n, (rows, *_) in enumerate(found)])
    point, value, terms, change = (np.concatenate(each) for each in zip(*found, strict=True))
    kept = np.bincount(point, minlength=1)[point] >= FEWEST_PHOTOS
    kept &= point % max(1, -(-kept.sum() // MOST_SIGHTINGS)) == 0
    _, point = np.unique(point[kept], return_inverse=True)
    assert scene.temperature is not None
    value, change = scene.temperature.span_c * np.stack([value, change])[:, kept]
    even_c = np.quantile(change, EVEN_SHARE) if len(change) else 0.0
    weight = 1 / (1 + (change / max(even_c, LEAST_ERROR_C)) ** 2) ** 2  # Geman-McClure
    return _Sightings(photo[kept], point, value, terms[kept], weight)


def _seen(
    photo: PosedImage, positions: Float[Tensor, "n 3"]
) -> tuple[
    Int[np.ndarray, " k"],
    Float[np.ndarray, " k"],
    Float[np.ndarray, "k 6"],
    Float[np.ndarray, " k"],
]:
    """Which points a photo shows, its values there, the terms of the shading, and by how much the
    values change about the points."""
    camera = photo.camera
    pixels, in_frame, hidden = framed_points(camera, positions)
    image = photo.look(SAMPLING_PX)
    values = image.values[..., 0].double().numpy()
    valid = np.ones_like(values) if image.valid is None else image.valid.double().numpy()
    sigma = SMOOTHED_PX * values.shape[1] / camera.width
    smooth = gaussian_filter(values * valid, sigma) / gaussian_filter(valid, sigma).clip(1e-3)
    place = pixels / pixels.new_tensor([camera.width, camera.height])
    column, row = (place * place.new_tensor(smooth.shape[::-1])).long().numpy().T
    about = 2 * max(1, round(sigma)) + 1
    change = maximum_filter(smooth, about) - minimum_filter(smooth, about)
    rows = np.flatnonzero((in_frame & ~hidden).numpy() & (valid[row, column] > 0))
    x, y = (2 * place[rows] - 1).T
    at = row[rows], column[rows]
    return rows, smooth[at], shading_terms(x, HEIGHT * y).numpy(), change[at]


def _fitted(
    seen: _Sightings, priors: Float[np.ndarray, " c"], minutes: Float[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, "c c"]]:
    """Offsets of P photos and the coefficients of the shading, °C, with their covariance, by least
    squares with Geman and McClure's weights; each point's temperature is eliminated as its mean."""
    photos, n, p = len(minutes), len(seen.value), 1 + seen.point.max(initial=-1)
    order = np.argsort(minutes)[: np.isfinite(minutes).sum()]
    one, next_one = order[:-1], order[1:]
    usual_c = DRIFT_C * np.sqrt(np.diff(minutes[order]).clip(1 / 60))
    columns = np.column_stack([seen.terms, seen.value])
    start = _starting_offsets(seen, photos)
    left = seen.value - start[seen.photo]
    residuals = left - _medians(left, seen.point, p)[seen.point]
    steps = 1 / (1 + ((start[next_one] - start[one]) / (2 * usual_c)) ** 2)
    found = np.full(len(priors), np.inf)
    for _ in range(ITERATIONS):
        noise_c = max(1.4826 * _weighted_median(np.abs(residuals), seen.weight), 1e-3)
        weights = seen.weight / (1 + (residuals / (2 * noise_c)) ** 2) ** 2
        by_point = csr_array((weights, (seen.point, np.arange(n))), (p, n))
        by_photo = csr_array((weights, (seen.photo, np.arange(n))), (photos, n))
        shared = csr_array((weights, (seen.photo, seen.point)), (photos, p))
        total = by_point.sum(axis=1)
        # Terms and values less their means over the photos that show the same point.
        off = columns - ((by_point @ columns) / total[:, None])[seen.point]
        own, cross = (shared / total[None]) @ shared.T, by_photo @ off
        inner = (columns * weights[:, None]).T @ off
        normal = np.block([
            [np.diag(by_photo.sum(axis=1)) - own.toarray(), cross[:, :-1]],
            [cross[:, :-1].T, inner[:-1, :-1]],
        ])  # fmt: skip
        variance = ALIKE * noise_c**2
        precision = normal / variance + np.diag(priors**-2.0)
        for rows, others, sign in ((one, one, 1), (next_one, next_one, 1), (one, next_one, -1)):
            np.add.at(precision, (rows, others), sign * steps / usual_c**2)
        np.add.at(precision, (next_one, one), -steps / usual_c**2)
        right = np.concatenate([cross[:, -1], inner[:-1, -1]]) / variance
        before, found = found, np.linalg.solve(precision, right)
        if np.abs(found - before).max() < CONVERGED_C:
            break
        left = seen.value - found[seen.photo] - seen.terms @ found[photos:]
        residuals = left - ((by_point @ left) / total)[seen.point]
        steps = 1 / (1 + ((found[next_one] - found[one]) / (2 * usual_c)) ** 2)
    gauge = np.eye(len(priors))
    gauge[:photos, :photos] -= 1 / photos
    return gauge @ found, gauge @ np.linalg.inv(precision) @ gauge


def _starting_offsets(seen: _Sightings, photos: int) -> Float[np.ndarray, " p"]:
    """Offsets of P photos, °C, by what most of the points that two photos show differ by, along the
    tree of the pairs that agree best. A mean would take for an offset what stands before the camera
    in one photo and hides the points that others see."""
    order = np.lexsort((seen.point, seen.photo))
    ends = np.searchsorted(seen.photo[order], np.arange(1, photos))
    points, values = (np.split(each[order], ends) for each in (seen.point, seen.value))
    known = csr_array((np.ones(len(order)), (seen.photo, seen.point)), (photos, 1 + MOST_POINTS))
    shared = np.triu((known @ known.T).toarray(), 1)
    apart, widths = np.zeros((2, photos, photos))
    for one in range(photos):
        for other in np.argsort(shared[one])[-MOST_PAIRS:]:
            if shared[one, other] < FEWEST_SHARED:
                continue
            _, mine, others = np.intersect1d(points[one], points[other], True, True)
            differences = np.sort(values[one][mine] - values[other][others])
            half = len(differences) // 4
            width = differences[half:] - differences[:-half]
            at = int(width.argmin())
            apart[other, one] = 0.5 * (differences[at] + differences[at + half])
            apart[one, other], widths[one, other] = -apart[other, one], width[at] + 1e-9
    offsets, tree = np.zeros(photos), minimum_spanning_tree(csr_array(widths))
    left = set(range(photos))
    while left:
        order, before = breadth_first_order(tree, min(left), directed=False)
        for photo in order[1:]:
            offsets[photo] = offsets[before[photo]] + apart[before[photo], photo]
        left -= set(order.tolist())
    return offsets


def _medians(
    values: Float[np.ndarray, " n"], groups: Int[np.ndarray, " n"], count: int
) -> Float[np.ndarray, " c"]:
    """The median of each of C groups, the upper one of two."""
    order = np.lexsort((values, groups))
    first = np.searchsorted(groups[order], np.arange(count + 1))
    middles: Float[np.ndarray, " c"] = values[order][(first[:-1] + first[1:]) // 2]
    return middles


def _weighted_median(values: Float[np.ndarray, " n"], weights: Float[np.ndarray, " n"]) -> float:
    """The value below which half of the weight is; 1 without values."""
    if not len(values):
        return 1.0
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])
