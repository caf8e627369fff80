"""The anomalies that the report proposes: the hottest and the coldest spots that differ from their
surroundings by more than the uncertainty, kept in the run until they are accepted or dropped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mrgs.marks import MarkReading, Marks, RunMarks
from mrgs.marks.mark import Mark, places_of
from mrgs.marks.regions import Regions
from mrgs.marks.run_marks import eye_of, spot_radius
from mrgs.report.spots import Spot, find_spots, surroundings
from mrgs.scene import THERMAL, Scene
from mrgs.survey import Survey

PROPOSED = 3
"""Largest number of hot places, and of cold ones, unless the survey sets them."""

CANDIDATES = 2
"""Candidates measured per proposal."""

LEAST_PHOTOS = 2
"""Number of photos that must see a proposed place."""

SAME_PLACE = 10.0
"""Distance from an earlier proposal, in its radii, below which a spot keeps that name."""


class Anomaly(NamedTuple):
    """A spot that was measured.

    Attributes:
        reading: of the spot as a mark.
        contrast: its temperature minus that of its surroundings, in the unit of the reading.
    """

    spot: Spot
    reading: MarkReading
    contrast: float

    @property
    def stands_out(self) -> bool:
        """Whether the contrast is more than its uncertainty, where that is known. The camera's
        limit of error is no part of it: the surroundings share it."""
        uncertainty = self.reading.uncertainty
        return uncertainty is None or abs(self.contrast) > uncertainty.of_differences


class Proposals(NamedTuple):
    """What the report proposes.

    Attributes:
        anomalies: by name, the hottest first.
        held_back: how many were as hot or as cold, but do not stand out of their uncertainty.
    """

    anomalies: Mapping[str, Anomaly]
    held_back: int


def propose(marks: RunMarks, scene: Scene, regions: Regions, survey: Survey) -> Proposals:
    """Find the hottest and the coldest spots that stand out, and keep them in the run as its
    proposals.

    Where a mark was made, or a proposal dropped, none is made again; not so in a large area, which
    says nothing of a place in it. A spot that was proposed before keeps its name.

    Args:
        survey: may set the numbers of proposals.

    Raises:
        SceneError: a photo cannot be read.
        RunError: the marks cannot be read or saved.
    """
    known = marks.marks
    judged = [np.array(mark.points) for mark in (*known.marks, *known.dropped)]
    stated = survey.hot_places, survey.cold_places
    counts = [PROPOSED if count is None else count for count in stated]
    most = CANDIDATES * max(counts)
    found = find_spots(scene.views, regions.render, most, scene.reach, judged)
    chosen = [
        _standing_out(spots[: CANDIDATES * count], count, marks, scene, regions)
        for spots, count in zip(found, counts, strict=True)
    ]
    named: dict[str, Anomaly] = {}

    def change(now: Marks) -> Marks:
        named.clear()
        for letter, (anomalies, _) in zip("HC", chosen, strict=True):
            named.update(_named(letter, anomalies, now))
        return replace(now, proposals=tuple(each.reading.mark for each in named.values()))

    marks.store.edit(change)
    return Proposals(named, sum(held_back for _, held_back in chosen))


def _standing_out(
    spots: Sequence[Spot], count: int, marks: RunMarks, scene: Scene, regions: Regions
) -> tuple[list[Anomaly], int]:
    """The first ``count`` spots that stand out, and how many before them do not. A spot that too
    few photos see as a mark counts as neither: what floats beside an outline is seen from one
    place."""
    least = min(LEAST_PHOTOS, len(scene.train_photos(THERMAL)))
    kept: list[Anomaly] = []
    held_back = 0
    for spot in spots:
        if len(kept) == count:
            break
        anomaly = _measured(spot, marks, scene, regions)
        if (anomaly.reading.photos or 0) < least:
            continue
        if anomaly.stands_out:
            kept.append(anomaly)
        else:
            held_back += 1
    return kept, held_back


def _measured(spot: Spot, marks: RunMarks, scene: Scene, regions: Regions) -> Anomaly:
    """A spot as a mark without a name of its own, seen from the view that shows it best."""
    view = scene.views[spot.view]
    camera = view.images[THERMAL].camera
    points = places_of([spot.position.tolist()])
    mark = Mark("?", "spot", points, eye_of(camera), spot_radius(points[0], camera, scene))
    contrast = spot.value - surroundings(view, spot, regions.render(camera))
    span = 1.0 if scene.temperature is None else scene.temperature.span_c
    return Anomaly(spot, marks.meter.read(mark, regions), span * contrast)


def _named(letter: str, anomalies: Sequence[Anomaly], marks: Marks) -> dict[str, Anomaly]:
    """Anomalies by their names: those of proposals at the same places, else the next that are
    free."""
    free = iter(marks.free_names(letter, len(anomalies)))
    left = [mark for mark in marks.proposals if mark.name.startswith(letter)]
    named = {}
    for anomaly in anomalies:
        same = next((mark for mark in left if _is_at(mark, anomaly.spot)), None)
        if same is not None:
            left.remove(same)
        name = next(free) if same is None else same.name
        reading = replace(anomaly.reading, mark=replace(anomaly.reading.mark, name=name))
        named[name] = anomaly._replace(reading=reading)
    return named


def _is_at(mark: Mark, spot: Spot) -> bool:
    distance = np.linalg.norm(np.array(mark.points[0]) - spot.position)
    return bool(distance < SAME_PLACE * mark.radius)
