"""The anomalies that the report proposes: the hottest and the coldest spots, kept in the run until
they are accepted or dropped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mrgs.marks import Marks, RunMarks
from mrgs.marks.mark import Mark, places_of
from mrgs.marks.regions import Regions
from mrgs.marks.run_marks import eye_of, spot_radius
from mrgs.marks.tables import value_text
from mrgs.pictures.values import in_unit
from mrgs.report.marks import ShownMark
from mrgs.report.pictures import photo_value, surroundings
from mrgs.report.spots import Spot, find_spots
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Scene, TemperatureRange, View

SAME_PLACE = 10.0
"""A spot that lies nearer to an earlier proposal than so many of its radii keeps its name."""


class ShownProposal(NamedTuple):
    """A proposal as the report shows it; numbers are formatted.

    Attributes:
        mark: as it would be if it were accepted.
        contrast: its temperature minus that of its surroundings.
        low: 10th percentile over the views.
        high: 90th percentile over the views.
        views: how many views see it.
        position: x, y, z in scene units.
        photo: temperature of the thermal photo there; None where it has no valid pixel.
        at_end: whether the photo is at an end of the recorded range there.
    """

    mark: ShownMark
    contrast: str
    low: str
    high: str
    views: int
    position: str
    photo: str | None
    at_end: bool


def propose(marks: RunMarks, scene: Scene, regions: Regions) -> dict[str, Spot]:
    """Find the hottest and the coldest spots, and keep them in the run as its proposals; returns
    them by name, the hottest first.

    Where a mark was made, or a proposal dropped, none is made again. A spot that was proposed
    before keeps its name.

    Args:
        marks: of the run.
        scene: of the run.
        regions: surfaces with an emissivity of their own, for which temperatures are corrected.

    Raises:
        RunError: the marks cannot be read or saved.
    """
    views, known = views_of(scene), marks.marks
    judged = [np.mean(mark.points, axis=0) for mark in (*known.marks, *known.dropped)]
    found = find_spots(views, regions.render, ball=scene.reach, judged=judged)
    named: dict[str, Spot] = {}

    def change(now: Marks) -> Marks:
        named.clear()
        for letter, spots in zip("HC", found, strict=True):
            named.update(_named(letter, spots, now))
        proposals = tuple(_mark(name, spot, views, scene) for name, spot in named.items())
        return replace(now, proposals=proposals)

    marks.store.edit(change)
    return named


def _named(letter: str, spots: Sequence[Spot], marks: Marks) -> dict[str, Spot]:
    """Spots by their names: those of proposals at the same places, else the next that are free."""
    free = iter(marks.free_names(letter, len(spots)))
    left = [mark for mark in marks.proposals if mark.name.startswith(letter)]
    named = {}
    for spot in spots:
        same = next((mark for mark in left if _is_at(mark, spot)), None)
        if same is not None:
            left.remove(same)
        named[next(free) if same is None else same.name] = spot
    return named


def _is_at(mark: Mark, spot: Spot) -> bool:
    distance = np.linalg.norm(np.array(mark.points[0]) - spot.position)
    return bool(distance < SAME_PLACE * mark.radius)


def _mark(name: str, spot: Spot, views: Sequence[View], scene: Scene) -> Mark:
    """A spot as a mark, seen from the view that shows it best."""
    camera = views[spot.view].images[THERMAL].camera
    points = places_of([spot.position.tolist()])
    return Mark(name, "spot", points, eye_of(camera), spot_radius(points[0], camera, scene))


def show_proposals(
    spots: Mapping[str, Spot], shown: Sequence[ShownMark], run: Run, scene: Scene, regions: Regions
) -> list[ShownProposal]:
    """Proposals as the report shows them.

    Args:
        spots: by name.
        shown: the same as marks.
        run: that they were found in.
        scene: with the photos.
        regions: surfaces with an emissivity of their own.

    Raises:
        SceneError: a photo cannot be read.
    """
    return [_shown(spots[mark.name], mark, run, scene, regions) for mark in shown]


def _shown(spot: Spot, mark: ShownMark, run: Run, scene: Scene, regions: Regions) -> ShownProposal:
    view, temperature = views_of(scene)[spot.view], scene.temperature
    rendering = regions.render(view.images[THERMAL].camera)
    contrast = spot.value - surroundings(view, spot, rendering)
    photo = photo_value(view, spot)
    x, y, z = spot.position
    return ShownProposal(
        mark,
        value_text(
            contrast if temperature is None else contrast * temperature.span_c,
            temperature,
            sign=True,
        ),
        _text(spot.low, temperature),
        _text(spot.high, temperature),
        spot.views,
        f"{x:.2f}, {y:.2f}, {z:.2f}".replace("-", "−"),
        None if photo is None else _text(photo, temperature),
        photo is not None and not 0 < photo < 1 and run.image_model.thermal_gain is None,
    )


def _text(value: float, temperature: TemperatureRange | None) -> str:
    return value_text(in_unit(THERMAL, value, temperature), temperature)


def views_of(scene: Scene) -> list[View]:
    """All views, in the order that spots count them in."""
    return [*scene.train, *scene.eval]
