"""Problems of a scene's images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from mrgs.check.problems import Problem, Severity
from mrgs.check.statistics import ViewStatistics
from mrgs.prepare.consistency import agreements, luma
from mrgs.prepare.page.previews import Preview, views_text
from mrgs.scene import Camera, Scene

_SATURATED = 0.02
"""Of a set's thermal pixels; a view counts as saturated at five times that."""

_FLAT = 0.01
"""Normalised: a thermal image whose values spread less shows nothing."""

_BLURRED = 0.4
"""Of the set's median sharpness."""

_FEWEST_TO_COMPARE = 5


def image_problems(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    """All problems that the pixels show."""
    rules: list[Callable[[Scene, Sequence[ViewStatistics]], list[Problem]]] = [
        _unreadable, _missing, _without_temperatures, _sizes, _flat, _saturated, _gain, _exposure,
        _blurred,
    ]  # fmt: skip
    return [problem for rule in rules for problem in rule(scene, statistics)]


def _unreadable(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    return [Problem("error", message) for one in statistics for message in one.failures]


def _missing(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    """Views that lack one of the two images."""
    views = [*scene.train, *scene.eval]
    found = []
    for kind, lacking in (
        ("thermal", [view.name for view in views if view.thermal is None]),
        ("RGB", [view.name for view in views if view.rgb is None]),
    ):
        if len(lacking) == len(views):
            what = "temperatures" if kind == "thermal" else "colours"
            text = f"No view has a {kind} image: the model will have no {what}."
            severity: Severity = "warning" if kind == "thermal" else "note"
            found.append(Problem(severity, text, "Name them in the file if there are any."))
        elif lacking:
            text = f"There is no {kind} image in {views_text(lacking)}."
            found.append(Problem("warning", text, f"Add the {kind} images, unless that is meant."))
    return found


def _without_temperatures(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    thermal = any(view.thermal for view in (*scene.train, *scene.eval))
    if scene.temperature is not None or not thermal:
        return []
    text = "There is no temperature_bounds.json: thermal values are relative, without °C."
    remedy = (
        "Add it with the temperatures of black and white, absolute_min_temperature and "
        "absolute_max_temperature."
    )
    return [Problem("warning", text, remedy)]


def _sizes(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    """Images of one kind in several sizes: another camera, or some were resized."""
    views = [*scene.train, *scene.eval]
    found = []
    for kind, images in (("RGB", [v.rgb for v in views]), ("thermal", [v.thermal for v in views])):
        sizes = Counter(
            f"{image.camera.width}×{image.camera.height}" for image in images if image is not None
        )
        if len(sizes) > 1:
            counts = ", ".join(f"{count} of {size} px" for size, count in sizes.items())
            text = f"The {kind} images are not of one size: {counts}."
            remedy = "That is right for several cameras, and wrong if some were resized."
            found.append(Problem("note", text, remedy))
    return found


def _flat(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    flat = [one.preview.name for one in statistics if one.spread is not None and one.spread < _FLAT]
    if not flat:
        return []
    severity: Severity = "error" if len(flat) == len(statistics) else "warning"
    text = f"The thermal image of {views_text(flat)} is flat: all its pixels are nearly equal."
    return [Problem(severity, text, "Replace these images, or leave them out.")]


def _saturated(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    found = []
    for end, shares in (
        (
            "lower",
            {one.preview.name: one.cold_end for one in statistics if one.cold_end is not None},
        ),
        ("upper", {one.preview.name: one.hot_end for one in statistics if one.hot_end is not None}),
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


def _gain(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    previews = [one.preview for one in statistics]
    names = _jumping(
        previews,
        [preview.thermal for preview in previews],
        [preview.thermal_camera for preview in previews],
        scene,
    )
    text = (
        f"In {views_text(names)} the same places are warmer or colder than in the others: an "
        f"automatic gain."
    )
    remedy = "Export all thermal images with one fixed span, or from radiometric files."
    return [Problem("warning", text, remedy)] if names else []


def _exposure(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    previews = [one.preview for one in statistics]
    brightness = [None if preview.rgb is None else luma(preview.rgb) for preview in previews]
    names = _jumping(previews, brightness, [preview.rgb_camera for preview in previews], scene)
    text = (
        f"In {views_text(names)} the same places are brighter or darker than in the others: an "
        f"automatic exposure."
    )
    remedy = "The colours will be a mixture; fix exposure and white balance next time."
    return [Problem("warning", text, remedy)] if names else []


def _jumping(
    previews: Sequence[Preview],
    images: Sequence[Float[np.ndarray, "..."] | None],
    cameras: Sequence[Camera | None],
    scene: Scene,
) -> list[str]:
    """Names of the views whose image has another gain or offset than most."""
    found = agreements(images, cameras, scene.points)
    pairs = zip(previews, found, strict=True)
    return [
        preview.name for preview, agreement in pairs if agreement is not None and agreement.jumps
    ]


def _blurred(scene: Scene, statistics: Sequence[ViewStatistics]) -> list[Problem]:
    known = {one.preview.name: one.sharpness for one in statistics if one.sharpness is not None}
    if len(known) < _FEWEST_TO_COMPARE:
        return []
    limit = _BLURRED * float(np.median(list(known.values())))
    blurred = [name for name, value in known.items() if value < limit]
    text = (
        f"The RGB image of {views_text(blurred)} is much less sharp than the others: motion blur, "
        f"or out of focus."
    )
    remedy = "Leave these views out, unless nothing else shows what they show."
    return [Problem("warning", text, remedy)] if blurred else []
