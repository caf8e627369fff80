"""What can be wrong with the images of a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mrgs.check.looks import Look
from mrgs.check.problems import Problem, Severity
from mrgs.prepare.consistency import agreements, luma
from mrgs.prepare.page.previews import views_text
from mrgs.scene import Scene

_SATURATED = 0.02
"""Of a set's thermal pixels; a view counts as saturated at five times that."""

_FLAT = 0.01
"""Normalised: a thermal image whose values spread less shows nothing."""

_BLURRED = 0.4
"""Of the set's median sharpness."""

_FEWEST_TO_COMPARE = 5


def image_problems(scene: Scene, looks: Sequence[Look]) -> list[Problem]:
    """Everything that the pixels tell."""
    rules: list[Callable[[Scene, Sequence[Look]], list[Problem]]] = [
        _unreadable, _missing, _without_temperatures, _sizes, _flat, _saturated, _gain, _exposure,
        _blurred,
    ]  # fmt: skip
    return [problem for rule in rules for problem in rule(scene, looks)]


def _unreadable(scene: Scene, looks: Sequence[Look]) -> list[Problem]:
    return [Problem("error", message) for look in looks for message in look.failures]


def _missing(scene: Scene, looks: Sequence[Look]) -> list[Problem]:
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


def _without_temperatures(scene: Scene, looks: Sequence[Look]) -> list[Problem]:
    if scene.temperature is not None or not any(
        view.thermal for view in (*scene.train, *scene.eval)
    ):
        return []
    text = (
        "There is no temperature_bounds.json: the thermal values are relative, and °C are not "
        "known."
    )
    remedy = (
        "Add it with the temperatures of black and white, absolute_min_temperature and "
        "absolute_max_temperature."
    )
    return [Problem("warning", text, remedy)]


def _sizes(scene: Scene, looks: Sequence[Look]) -> list[Problem]:
    """Images of one kind that are not of one size: another camera, or some were resized."""
    views = [*scene.train, *scene.eval]
    found = []
    for kind, images in (("RGB", [v.rgb for v in views]), ("thermal", [v.thermal for v in views])):
        sizes: dict[str, int] = {}
        for image in images:
            if image is not None:
                size = f"{image.camera.width}×{image.camera.height}"
                sizes[size] = sizes.get(size, 0) + 1
        if len(sizes) > 1:
            counts = ", ".join(f"{count} of {size} px" for size, count in sizes.items())
            text = f"The {kind} images are not of one size: {counts}."
            found.append(
                Problem(
                    "note",
                    text,
                    "That is right for several cameras, and wrong if some were resized.",
                )
            )
    return found


def _flat(scene: Scene, looks: Sequence[Look]) -> list[Problem]:
    flat = [look.preview.name for look in looks if look.spread is not None and look.spread < _FLAT]
    if not flat:
        return []
    text = (
        f"The thermal image of {views_text(flat)} shows next to nothing: all its pixels are "
        f"nearly equal."
    )
    return [
        Problem(
            "error" if len(flat) == len(looks) else "warning",
            text,
            "Replace or leave out these images.",
        )
    ]


def _saturated(scene: Scene, looks: Sequence[Look]) -> list[Problem]:
    found = []
    for end, shares in (
        (
            "lower",
            {look.preview.name: look.cold_end for look in looks if look.cold_end is not None},
        ),
        ("upper", {look.preview.name: look.hot_end for look in looks if look.hot_end is not None}),
    ):
        mean = float(np.mean(list(shares.values()))) if shares else 0.0
        if mean > _SATURATED:
            views = [name for name, share in shares.items() if share > 5 * _SATURATED]
            most = f", most in {views_text(views)}" if views else ""
            text = (
                f"{mean:.0%} of the thermal pixels lie at the {end} end of the scale{most}: "
                f"what they were is lost."
            )
            remedy = (
                "Export the thermal images again with a wider fixed span, or correct "
                "temperature_bounds.json."
            )
            found.append(Problem("warning", text, remedy))
    return found


def _gain(scene: Scene, looks: Sequence[Look]) -> list[Problem]:
    shots = [look.preview for look in looks]
    found = agreements(
        [shot.thermal for shot in shots], [shot.thermal_camera for shot in shots], scene.points
    )
    names = [
        shot.name for shot, own in zip(shots, found, strict=True) if own is not None and own.jumps
    ]
    if not names:
        return []
    text = (
        f"In {views_text(names)} the same places are warmer or colder than in the others: an "
        f"automatic gain."
    )
    return [
        Problem(
            "warning",
            text,
            "Export all thermal images with one fixed span, or from radiometric files.",
        )
    ]


def _exposure(scene: Scene, looks: Sequence[Look]) -> list[Problem]:
    shots = [look.preview for look in looks]
    images = [None if shot.rgb is None else luma(shot.rgb) for shot in shots]
    found = agreements(images, [shot.rgb_camera for shot in shots], scene.points)
    names = [
        shot.name for shot, own in zip(shots, found, strict=True) if own is not None and own.jumps
    ]
    if not names:
        return []
    text = (
        f"In {views_text(names)} the same places are brighter or darker than in the others: an "
        f"automatic exposure."
    )
    return [
        Problem(
            "warning",
            text,
            "The colours will be a mixture; fix the exposure and the white balance next time.",
        )
    ]


def _blurred(scene: Scene, looks: Sequence[Look]) -> list[Problem]:
    known = {look.preview.name: look.sharpness for look in looks if look.sharpness is not None}
    if len(known) < _FEWEST_TO_COMPARE:
        return []
    limit = _BLURRED * float(np.median(list(known.values())))
    blurred = [name for name, value in known.items() if value < limit]
    if not blurred:
        return []
    text = (
        f"The RGB image of {views_text(blurred)} is much less sharp than the others: moved, or "
        f"out of focus."
    )
    return [
        Problem("warning", text, "Leave these views out, unless nothing else shows what they show.")
    ]
