"""Problems of a scene's images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from mrgs.check.poses import cameras_by_modality
from mrgs.check.problems import Problem, Severity
from mrgs.check.statistics import ImageStatistics, ViewStatistics
from mrgs.prepare.consistency import (
    GAIN_CAUSE,
    RADIOMETRIC_CAUSE,
    RADIOMETRIC_REMEDY,
    agreements,
    brightness,
)
from mrgs.prepare.page.previews import views_text
from mrgs.scene import RGB, THERMAL, Modality, Scene
from mrgs.scene.modality import in_order

_SATURATED = 0.02
"""Share of a set's thermal pixels that gives a warning; a view is named at five times that."""

_UNIFORM = 0.01
"""An image with a smaller range of values (normalised, 1 % to 99 % quantile) has no content."""

_BLURRED = 0.4
"""Share of the set's median sharpness below which an image counts as blurred."""

_FEWEST_TO_COMPARE = 5

_EXPECTED: dict[Modality, tuple[Severity, str]] = {
    THERMAL: ("warning", "temperatures"),
    RGB: ("note", "colours"),
}
"""Severity if no view has an image of a modality, and what the model will then lack."""


def image_problems(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    """All problems that the pixels show."""
    rules: list[Callable[[Scene, Sequence[ViewStatistics]], list[Problem]]] = [
        _unreadable, _missing, _without_temperatures, _sizes, _uniform, _saturated, _jumps,
        _blurred,
    ]  # fmt: skip
    return [problem for rule in rules for problem in rule(scene, statistics)]


def _of_modality(
    modality: Modality, statistics: Sequence[ViewStatistics]
) -> dict[str, ImageStatistics]:
    """Statistics of the images of a modality, by the view's name."""
    return {one.preview.name: one.images[modality] for one in statistics if modality in one.images}


def _unreadable(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    return [Problem("error", message) for one in statistics for message in one.failures]


def _missing(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    """Views that lack an image of a modality."""
    views = scene.views
    present = cameras_by_modality(scene)
    found = []
    for modality in in_order((*_EXPECTED, *present)):
        title = modality.title
        lacking = [view.name for view in views if modality not in view.images]
        if modality not in present:
            severity, what = _EXPECTED[modality]
            text = f"No view has any {title} image: the model will have no {what}."
            found.append(Problem(severity, text, "Name them in the file if there are any."))
        elif lacking:
            text = f"There is no {title} image in {views_text(lacking)}."
            found.append(Problem("warning", text, f"Add the {title} images, unless that is meant."))
    return found


def _without_temperatures(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    if scene.temperature is not None or THERMAL not in cameras_by_modality(scene):
        return []
    text = "There is no temperature_bounds.json: thermal values are relative, without °C."
    remedy = (
        "Add it with the temperatures of black and white, absolute_min_temperature and "
        "absolute_max_temperature."
    )
    return [Problem("warning", text, remedy)]


def _sizes(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    """Images of a modality in several sizes: another camera, or some were resized."""
    found = []
    for modality, cameras in cameras_by_modality(scene).items():
        sizes = Counter(f"{camera.width}×{camera.height}" for camera in cameras.values())
        if len(sizes) > 1:
            counts = ", ".join(f"{count} of {size} px" for size, count in sizes.items())
            text = f"The {modality.title} images are not of one size: {counts}."
            remedy = "That is right for several cameras, and wrong if some were resized."
            found.append(Problem("note", text, remedy))
    return found


def _uniform(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    """Images without content, in any modality."""
    found = []
    for modality in scene.modalities:
        images = _of_modality(modality, statistics)
        flat = [name for name, image in images.items() if image.spread < _UNIFORM]
        if flat:
            severity: Severity = "error" if len(flat) == len(statistics) else "warning"
            text = (
                f"The {modality.title} image of {views_text(flat)} is uniform: all its pixels have "
                f"nearly the same value, as behind a lens cap."
            )
            found.append(Problem(severity, text, "Leave these views out, or retake the photos."))
    return found


def _saturated(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    """Temperatures beyond the scale. Colours may be black or white."""
    found = []
    images = _of_modality(THERMAL, statistics)
    for end, shares in (
        ("lower", {name: image.low_end for name, image in images.items()}),
        ("upper", {name: image.high_end for name, image in images.items()}),
    ):
        mean = float(np.mean(list(shares.values()))) if shares else 0.0
        if mean > _SATURATED:
            views = [name for name, share in shares.items() if share > 5 * _SATURATED]
            most = f", most in {views_text(views)}" if views else ""
            text = (
                f"{mean:.0%} of the thermal pixels lie at the {end} end of the scale{most}: their "
                f"temperatures are lost."
            )
            remedy = (
                "Export the thermal images again with a wider fixed span, or correct "
                "temperature_bounds.json."
            )
            found.append(Problem("warning", text, remedy))
    return found


def _jumps(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    """Images whose gain or offset differs from that of most."""
    found = []
    for modality in scene.modalities:
        views = [one.preview for one in statistics if modality in one.preview.images]
        images = [view.images[modality] for view in views]
        relations = agreements(
            [brightness(image.pixels) for image in images],
            [image.camera for image in images],
            scene.points,
        )
        names = [
            view.name
            for view, relation in zip(views, relations, strict=True)
            if relation is not None and relation.jumps
        ]
        if names:
            found.append(_jump(modality, names, _is_radiometric(scene)))
    return found


def _is_radiometric(scene: Scene) -> bool:
    """Whether the temperatures come from the thermal camera's signal."""
    return any(record.is_radiometric for record in scene.records)


def _jump(modality: Modality, names: Sequence[str], radiometric: bool) -> Problem:
    changed, cause, remedy = (
        "warmer or colder",
        GAIN_CAUSE,
        "Export all thermal images with one fixed span, or from radiometric files.",
    )
    if modality != THERMAL:
        changed, cause, remedy = (
            "brighter or darker",
            "as automatic exposure makes them",
            "The colours will be a mixture; fix exposure and white balance next time.",
        )
    elif radiometric:
        cause, remedy = RADIOMETRIC_CAUSE, RADIOMETRIC_REMEDY
    text = f"In {views_text(names)} the same places are {changed} than in the others, {cause}."
    return Problem("warning", text, remedy)


def _blurred(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    """Images without fine details. Thermal images have few in any case."""
    found = []
    for modality in scene.modalities:
        known = {
            name: image.sharpness for name, image in _of_modality(modality, statistics).items()
        }
        if modality == THERMAL or len(known) < _FEWEST_TO_COMPARE:
            continue
        limit = _BLURRED * float(np.median(list(known.values())))
        if blurred := [name for name, value in known.items() if value < limit]:
            text = (
                f"The {modality.title} image of {views_text(blurred)} is much less sharp than the "
                f"others: motion blur, or out of focus."
            )
            remedy = "Leave these views out, unless nothing else shows what they show."
            found.append(Problem("warning", text, remedy))
    return found
