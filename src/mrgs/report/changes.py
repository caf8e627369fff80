"""Two dates of one object: where its surface has become warmer or colder from one run to another.

The second run is aligned with the first. A place of the surface has changed where the second date
shows a temperature there that the first one shows nowhere close by, beside the change that most of
the surface has in common: a small error of the alignment changes nothing.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float64, Int64
from PIL import Image
from scipy import ndimage, sparse
from scipy.spatial import ConvexHull, KDTree

from mrgs.errors import ConfigError, RunError
from mrgs.maps.crs import coordinate_system, local_wkt
from mrgs.maps.draw import write_geotiff
from mrgs.maps.registration import Registration, register
from mrgs.maps.surfaces import survey_pixel
from mrgs.marks import MarkReading, RunMarks, open_marks
from mrgs.marks.mark import Mark, MarkKind, Marks, Place, places_of
from mrgs.marks.photo_readings import COVERAGE
from mrgs.marks.tables import DASH, digits, write_features, write_rows
from mrgs.marks.uncertainty import InputQuantity, Uncertainty, shared_difference
from mrgs.pictures.files import write_png
from mrgs.pictures.html import PAGE_STYLE, inline_image, write_html
from mrgs.pictures.palette import display_range
from mrgs.pictures.values import in_unit
from mrgs.report.copies import require_packages, write_copies
from mrgs.report.overview import Style, TemperatureMap, draw_temperature_map, has_map
from mrgs.report.texts import Language, Texts
from mrgs.runs.baked import bake
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Scene, WorldFrame, evenly_spaced
from mrgs.scene.depth_map import DepthMap
from mrgs.system.wording import Message, number_text

Points: TypeAlias = Float64[np.ndarray, "n 3"]
Values: TypeAlias = Float64[np.ndarray, " n"]

LEAST_K = 1.0
"""Changes by less are not listed."""

REACH_PX = 2.0
"""Temperatures that the other date has within this distance, in pixels of the photos, are no
change: alignment and depths are not more exact."""

BEGINS, CONTINUES = 0.6, 0.5
"""Shares of the least change by which places must differ to make, and to belong to, a change."""

CORE = 0.5
"""A change is where ΔT is at least this share of its largest values, the upper twentieth."""

FEWEST_PHOTOS = 3
"""Photos of each date that must show a place: nothing confirms the depth of what fewer show."""

FEWEST_PLACES = 8
LEAST_PX = 2.0
"""Width of a change, in pixels of the photos: a camera measures nothing narrower."""

CERTAIN = 2.0
"""Multiple of its ± by which a place must have changed: ± covers 95 % of places, and of thousands
searched some exceed it by chance."""

RING_PX = 4.0
"""Width of the surroundings of a change, in pixels of the photos."""

ADJOINING = 0.08
"""Share of the surroundings that are as hot or cold on both dates, from which on what changed is
the edge of that place."""

MOST_PLACES, MOST_CORNERS, MOST_PIECES = 2_000_000, 100, 9
MOST_CUBES = 2**62
"""Numbers of more cubes are not integers of 64 bits."""


ChangeKind = Literal["new", "gone", "grown", "shrunk", "warmer", "colder"]


class Compared(NamedTuple):
    """A change or a mark on two dates; °C and K, lengths and places as in the first run.

    Attributes:
        mark: with its name and outline; of a change the outline is convex.
        kind: of a change, see ``kind_of``, or of a mark.
        before: mean temperature on the first date, NaN where there is none.
        after: the same on the second date.
        difference: after − before, relative to the common change if that was asked for.
        uncertainty: half the width of the interval of the difference for 95 of 100 cases.
        area: of the changed surface, scene units squared; NaN where it has none.
        problem: why there is no difference, a sentence; else empty.
        places: of the surface that were measured for a change, [N, 3]; None for a mark.
    """

    mark: Mark
    kind: ChangeKind | MarkKind
    before: float
    after: float
    difference: float
    uncertainty: float
    area: float = math.nan
    problem: str = ""
    places: Points | None = None


class _Date:
    """A run with what measures in it; ``marks`` are those of the first run in its coordinates."""

    def __init__(self, marked: RunMarks, marks: Marks, number: int, same_camera: bool) -> None:
        self.run, self.meter, self.marks = marked.run, marked.meter, marks
        self.number, self.same_camera = number, same_camera
        assert marked.scene is not None
        assert marked.meter.uncertainty is not None
        assert marked.meter.uncertainty.budget is not None
        self.scene, self.uncertainty = marked.scene, marked.meter.uncertainty
        self.budget = marked.meter.uncertainty.budget
        self.regions = self.meter.regions(marks)

    def celsius(self, points: Points) -> tuple[Values, Values]:
        """°C of points on surfaces, corrected for areas with settings of their own, and as the
        photos' cameras see them; NaN where fewer than ``FEWEST_PHOTOS`` see one."""
        seen = self.meter.survey.temperatures(points.astype(np.float32), FEWEST_PHOTOS)
        seen = seen.astype(np.float64)
        celsius = in_unit(THERMAL, seen, self.run.temperature)
        return self.regions.corrected_at(points, celsius), celsius

    def of_change(self, points: Points, in_photos: Values) -> Uncertainty:
        """Uncertainty of the mean of a change's places; where no single photo shows enough of them,
        photos and model count as for the pieces that single photos show (root mean square)."""
        found = self.uncertainty.of_mark(points, in_photos, self.regions)
        if math.isnan(found.own):
            single = points.astype(np.float32)
            shown = [each.shown(single).rows for _, each in self.meter.survey.near(single)]
            shown = [rows for rows in shown if len(rows) >= FEWEST_PLACES]
            pieces = [shown[index] for index in evenly_spaced(len(shown), MOST_PIECES)]
            every = [self.uncertainty.of_mark(points[each], in_photos[each]) for each in pieces]
            own = [each.own for each in every if not math.isnan(each.own)]
            part = float(np.sqrt(np.mean(np.square(own or self.uncertainty.of_photos(single)))))
            surfaces, place = self.regions.parts(points), float(points.mean())
            found = self.budget.of_mean(Uncertainty(part), in_photos, surfaces, place)
        return self.dated(found)

    def dated(self, uncertainty: Uncertainty) -> Uncertainty:
        """The ± with the input quantities of this date told from those of the other: a surface
        keeps its emissivity, and a camera its calibration."""
        kept = {"emissivity"} | ({"camera"} if self.same_camera else set())
        shared = {
            each if each.name in kept else each._replace(name=f"{each.name} {self.number}"): part
            for each, part in uncertainty.shared.items()
        }
        if self.same_camera or not any(each.name == "camera" for each in uncertainty.shared):
            shared[InputQuantity("constant", float(self.number))] = self.constant_c
        return replace(uncertainty, shared=shared)

    def common(self, celsius: float) -> Mapping[InputQuantity, float]:
        """What input quantities contribute to a temperature, °C as the photos have it."""
        budget = self.budget
        parts = budget.contributions(np.array([celsius]), budget.capture.surface)
        shared = {each: float(part[0]) for each, part in parts.items() if each.name != "evenness"}
        return self.dated(Uncertainty(shared=shared)).shared

    @cached_property
    def constant_c(self) -> float:
        """What the drift leaves open, K: all temperatures of a run may be off by one constant,
        which is about as large as the photos' offsets are from each other."""
        drift = self.run.image_model.thermal_drift
        if drift is None or self.run.temperature is None or float(self.run.image_model.constant):
            return 0.0
        offsets = drift.offsets().double().numpy()
        return COVERAGE * self.run.temperature.span_c * float(offsets.std())


def _on_both(
    dates: tuple[_Date, _Date], registration: Registration, points: Points
) -> Float64[np.ndarray, "3 n"]:
    """°C on both dates of points of the first run's surface, and the uncertainty of their
    difference by photos and models alone; NaN where a date does not show them."""
    found = np.full((4, len(points)), np.nan)
    for number, (date, each) in enumerate(zip(dates, (points, registration(points)), strict=True)):
        found[number] = date.celsius(each)[0]
        found[2 + number] = date.uncertainty.of_photos(each.astype(np.float32))
    found[:, np.isnan(found[:2]).any(axis=0)] = np.nan
    return np.stack([found[0], found[1], np.hypot(found[2], found[3])])


@dataclass(frozen=True, eq=False)
class Differences:
    """What has changed on the surface that both dates show, see ``diff_runs``.

    Attributes:
        registration: from the first run's coordinates to the second one's.
        common_uncertainty: of ``common``, half the width of its interval.
        relative: whether ``common`` has been subtracted from all differences.
        least_k: smallest change beside ``common`` that is listed, K.
        changes: the places that changed beside ``common``, the most certain first.
        marks: the first run's marks.
        surface: places about a pixel of the photos apart, with °C on both dates.
        dates: the runs and what measures in them.
        ignored: names of the second run's areas with settings of their own that are no such areas
            of the first one, whose marks count on both dates.
    """

    registration: Registration
    common_uncertainty: float
    relative: bool
    least_k: float
    changes: tuple[Compared, ...]
    marks: tuple[Compared, ...]
    surface: Surface
    dates: tuple[_Date, _Date]
    ignored: tuple[str, ...] = ()

    @property
    def common(self) -> float:
        """The median of ΔT over the surface, K: the weather, or what drift leaves open."""
        return self.surface.common

    def at(self, points: Points) -> Float64[np.ndarray, "4 n"]:
        """ΔT, °C on both dates, and the uncertainty of ΔT by photos and models alone, of points on
        the first run's surface; NaN where a date does not show them. SceneError if a photo cannot
        be read."""
        before, after, around = _on_both(self.dates, self.registration, points)
        common = self.common if self.relative else 0.0
        return np.stack([after - before - common, before, after, around])

    def rows(self, language: Language = "en") -> tuple[list[list[str]], list[list[str]]]:
        """Changes and marks as texts under ``HEADINGS``, and why there is no difference."""
        t, world = Texts(language), self.dates[0].scene.world
        changes, marks = (
            [_row(each, t, world) for each in some] for some in (self.changes, self.marks)
        )
        return changes, marks

    def write(self, folder: str | Path, language: Language = "en", pdf: bool = False) -> list[Path]:
        """Write ``diff.html``, ``changes.csv`` and ``changes.geojson`` into a folder; where the
        first run is a façade or seen from above also ``difference.png`` and, if it is in metres,
        with mrgs[export] ``difference.tif``; and on request the page as PDF. Returns the paths.

        ConfigError if that needs weasyprint of mrgs[report], RunError if a file cannot be written,
        SceneError if a photo cannot be read."""
        require_packages(pdf)
        folder, t, (first, second) = Path(folder), Texts(language), self.dates
        world, every = first.scene.world, (*self.changes, *self.marks)
        rows = [facts_of(each, world) for each in every]
        marks = (each.mark for each in every)
        paths = [
            write_rows(folder / "changes.csv", columns(world), rows),
            write_features(folder / "changes.geojson", zip(rows, marks, strict=True), world),
        ]
        figure = None
        if (drawn := _difference_map(self)) is not None:
            picture = _map_picture(drawn, self, t)
            paths += [write_png(folder / "difference.png", picture), *_geotiff(drawn, self, folder)]
            figure = inline_image(picture, t("temperature difference"), png=True)
        changes, listed = self.rows(language)
        residual = f"{digits(self.registration.residual, 2)} {world.length_unit}"
        notes = [note for each in self.dates for note in each.uncertainty.notes]
        if self.ignored:
            said = Message(
                "Settings that only the second run's marks have are not used: {name}. Give them to "
                "marks of the first run.",
                name=", ".join(self.ignored),
            )
            notes.append(said)
        page = write_html(
            folder / "diff.html",
            "report/diff.html",
            title=f"{first.scene.name} → {second.scene.name}",
            subtitle=t.date(datetime.date.today()),
            styles=[PAGE_STYLE, "report/report.css"],
            language=language,
            t=t,
            found=self,
            figure=figure,
            headings=HEADINGS,
            changes=changes,
            marks=listed,
            least=f"{self.least_k:g}",
            residual=t.number(residual),
            kelvin=lambda value, sign: t.number(number_text(value, 1, sign=sign)),
            runs=[str(each.run.folder.path) for each in self.dates],
            notes=[t(note) for note in dict.fromkeys(notes)],
        )
        pdfs = write_copies(page, pdf)
        return [page, *paths, *pdfs]


def _check(first: Run, second: Run, least_k: float) -> None:
    if not least_k > 0:
        raise ConfigError(f"a least change of {least_k:g} K is not above 0", options=("least_k",))
    if first.folder.path.resolve() == second.folder.path.resolve():
        raise ConfigError(f"{first.folder.path} is given twice: give the runs of two dates")
    for run in (first, second):
        if run.temperature is None or THERMAL not in run.modalities:
            raise RunError(f"{run.folder.path} has no temperatures in °C to be compared")


def _same_camera(one: Scene, other: Scene) -> bool:
    """Whether one thermal camera took the photos of both, by its serial number."""
    serials = [{record.serial for record in each.records} for each in (one, other)]
    return serials[0] == serials[1] and len(serials[0]) == 1 and "" not in serials[0]


def moved_mark(registration: Registration, mark: Mark) -> Mark:
    """A mark of the first run in the second one's coordinates."""
    *points, eye = registration(np.array([*mark.points, mark.eye], np.float64)).tolist()
    radius = registration.scale * mark.radius
    return replace(mark, points=places_of(points), eye=tuple(eye), radius=radius)


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface that both dates show, as places about ``pixel`` scene units apart, that of the
    coarser date's photos: °C on both dates, the uncertainty of their difference by photos and
    models, K, [N], and the pairs of neighbours, [P, 2]."""

    points: Points
    pixel: float
    before: Values
    after: Values
    around: Values
    pairs: Int64[np.ndarray, "p 2"]

    @classmethod
    def of(cls, dates: tuple[_Date, _Date], registration: Registration) -> Surface:
        """The surface of two runs. RunError if they have none in common, SceneError if a photo
        cannot be read."""
        maps = list(dates[0].meter.survey)
        first, second = survey_pixel(maps), survey_pixel([*dates[1].meter.survey])
        points, pixel = _thinned(maps, max(first, second / registration.scale))
        values = _on_both(dates, registration, points)
        known = np.isfinite(values).all(axis=0)
        if known.sum() < FEWEST_PLACES:
            raise RunError(
                f"the runs have no surface in common that {FEWEST_PHOTOS} thermal photos of each "
                "show"
            )
        pairs = KDTree(points[known]).query_pairs(REACH_PX * pixel, output_type="ndarray")
        before, after, around = values[:, known]
        return cls(points[known], pixel, before, after, around, pairs)

    @cached_property
    def common(self) -> float:
        """The median of the change."""
        return float(np.median(self.after - self.before))

    @cached_property
    def beside_common(self) -> Values:
        """ΔT without the common change."""
        return self.after - self.before - self.common

    @cached_property
    def certain(self) -> Values:
        """ΔT without the common change, as far as no place of the other date within reach has such
        a temperature."""
        (low, high), (lowest, highest) = map(self._extremes, (self.before, self.after))
        shift = self.common
        up = np.maximum(self.after - high - shift, lowest - self.before - shift)
        down = np.maximum(low + shift - self.after, self.before + shift - highest)
        return np.maximum(up, 0) - np.maximum(down, 0)

    def _extremes(self, values: Values) -> tuple[Values, Values]:
        low, high = values.copy(), values.copy()
        for one, other in (self.pairs.T, self.pairs.T[::-1]):
            np.minimum.at(low, one, values[other])
            np.maximum.at(high, one, values[other])
        return low, high

    def parts(self, least_k: float) -> list[Bool[np.ndarray, " n"]]:
        """Connected parts that have changed, by their places."""
        found = []
        for sign in (1, -1):
            change = sign * self.certain
            begins = change > np.maximum(BEGINS * least_k, self.around)
            continues = change > CONTINUES * least_k
            pairs = self.pairs[continues[self.pairs].all(axis=1)]
            for part in self._connected(continues, begins, pairs):
                most = np.quantile(change[part], 0.95)
                core = part & (sign * self.beside_common >= CORE * most)
                found += self._connected(core, begins, pairs)
        return found

    def _connected(
        self,
        where: Bool[np.ndarray, " n"],
        begins: Bool[np.ndarray, " n"],
        pairs: Int64[np.ndarray, "p 2"],
    ) -> list[Bool[np.ndarray, " n"]]:
        """The connected parts of some places with enough places that begin one."""
        rows, number = np.flatnonzero(where), np.zeros(len(where), np.int64)
        number[rows] = np.arange(len(rows))
        kept = number[pairs[where[pairs].all(axis=1)]]
        graph = sparse.coo_matrix((np.ones(len(kept)), kept.T), shape=(len(rows),) * 2)
        labels = sparse.csgraph.connected_components(graph, directed=False)[1]
        begun = np.bincount(labels, weights=begins[rows])
        found = []
        for label in np.flatnonzero(begun >= FEWEST_PLACES):
            part = np.zeros(len(where), bool)
            part[rows[labels == label]] = True
            found.append(part)
        return found

    def surroundings(self, part: Bool[np.ndarray, " n"], least_k: float) -> Bool[np.ndarray, " n"]:
        """The places about a part that have not changed."""
        inside, reach = self.points[part], RING_PX * self.pixel
        low, high = inside.min(axis=0) - reach, inside.max(axis=0) + reach
        rows = np.flatnonzero(((self.points >= low) & (self.points <= high)).all(axis=1))
        near = KDTree(inside).query(self.points[rows], distance_upper_bound=reach)[0]
        found = np.zeros(len(part), bool)
        found[rows[np.isfinite(near)]] = True
        return found & ~part & (np.abs(self.beside_common) < least_k / 2)


def _thinned(maps: Sequence[DepthMap], pixel: float) -> tuple[Points, float]:
    """The mean of the maps' points in each cube, which is as wide as a pixel or wider, and its
    width; map by map, for memory."""
    points, weights = np.empty((0, 3)), np.empty(0)
    origin = np.min([each.points().min(axis=0, initial=np.inf) for each in maps], axis=0)
    for each in maps:
        points = np.concatenate([points, each.points()])
        weights = np.append(weights, np.ones(len(points) - len(weights)))
        while len(points):
            cubes = np.floor((points - origin) / pixel).astype(np.int64)
            sizes = cubes.max(axis=0) + 1
            if math.prod(sizes.tolist()) < MOST_CUBES:
                key = np.ravel_multi_index(tuple(cubes.T), tuple(sizes))
                taken, cube = np.unique(key, return_inverse=True)
                if len(taken) <= MOST_PLACES:
                    sums = [np.bincount(cube, weights * axis) for axis in points.T]
                    weights = np.bincount(cube, weights).astype(np.float64)
                    points = np.stack(sums, axis=1) / weights[:, None]
                    break
            pixel *= 1.4
    return points, pixel


class _Comparison:
    """Measures changes and marks on two dates, with the uncertainty of the difference."""

    def __init__(
        self,
        dates: tuple[_Date, _Date],
        registration: Registration,
        surface: Surface,
        relative: bool,
    ) -> None:
        self._dates, self._registration = dates, registration
        self._surface, self._relative = surface, relative
        medians = np.median(surface.before), np.median(surface.after)
        self._common = [date.common(float(c)) for date, c in zip(dates, medians, strict=True)]
        self.common_uncertainty = math.hypot(*shared_difference(*self._common).values())

    def of_change(
        self, part: Bool[np.ndarray, " n"], least_k: float
    ) -> tuple[float, Compared] | None:
        """A part of the surface that has changed, and how certain that is: 1 if its ΔT beside the
        common change is just as large as it must be; None if it is too narrow."""
        surface, points = self._surface, self._surface.points[part]
        outline, area, width = outline_of(points, surface.pixel)
        if width < LEAST_PX * surface.pixel:
            return None
        placed = points, self._registration(points)
        celsius = [date.celsius(each) for date, each in zip(self._dates, placed, strict=True)]
        before, after = (float(corrected.mean()) for corrected, _ in celsius)
        around = [
            date.of_change(each, in_photos)
            for date, each, (_, in_photos) in zip(self._dates, placed, celsius, strict=True)
        ]
        kind = kind_of(surface.before, surface.after, part, surface.surroundings(part, least_k))
        mark = Mark("D", "polygon", outline, self._eye(points))
        beside, least = self._difference(before, after, around, True)
        difference = self._difference(before, after, around, self._relative)
        certainty = abs(beside) / max(CERTAIN * least, least_k)
        return certainty, Compared(mark, kind, before, after, *difference, area, "", points)

    def of_mark(self, one: MarkReading, other: MarkReading) -> Compared:
        """A mark that was read on both dates."""
        mark, problem = one.mark, one.problem or other.problem
        around = [
            date.dated(reading.uncertainty)
            for date, reading in zip(self._dates, (one, other), strict=True)
            if reading.uncertainty is not None
        ]
        found = math.nan, math.nan
        if len(around) == 2 and not problem:
            found = self._difference(one.mean, other.mean, around, self._relative)
        return Compared(mark, mark.kind, one.mean, other.mean, *found, one.area, problem)

    def _difference(
        self, before: float, after: float, around: Sequence[Uncertainty], relative: bool
    ) -> tuple[float, float]:
        """ΔT and its uncertainty, in which what both dates share counts once."""
        one, other = around
        shared, common = shared_difference(one.shared, other.shared), 0.0
        if relative:
            common = self._surface.common
            for quantity, part in shared_difference(*self._common).items():
                shared[quantity] = shared.get(quantity, 0.0) - part
        total = math.hypot(one.own, other.own, *shared.values())
        return after - before - common, total

    def _eye(self, points: Points) -> Place:
        """The nearest camera that sees the middle of a part."""
        middle = points[((points - points.mean(axis=0)) ** 2).sum(axis=1).argmin()]
        point = middle[None].astype(np.float32)
        cameras = [
            each.camera.position.numpy()
            for _, each in self._dates[0].meter.survey.near(point)
            if len(each.shown(point).rows)
        ]
        x, y, z = min(cameras, key=lambda place: float(np.linalg.norm(place - middle))).tolist()
        return x, y, z


def kind_of(
    before: Values, after: Values, part: Bool[np.ndarray, " n"], ring: Bool[np.ndarray, " n"]
) -> ChangeKind:
    """What happened to a part of a surface, by its contrast to its surroundings on both dates."""
    change = after[part].mean() - before[part].mean()
    if not ring.any():
        return "warmer" if change > 0 else "colder"
    level = np.median(before[ring]), np.median(after[ring])
    contrast = before[part].mean() - level[0], after[part].mean() - level[1]
    step = contrast[1] - contrast[0]
    was, is_ = (abs(each) > 0.5 * abs(step) for each in contrast)
    if was == is_:
        return "warmer" if step > 0 else "colder"
    # Beside the part, what is as hot or cold on both dates.
    found = contrast[1] if is_ else contrast[0]
    alike = [
        (values[ring] - each) / found > 0.5
        for values, each in zip((before, after), level, strict=True)
    ]
    adjoins = np.logical_and(*alike).mean() > ADJOINING
    if is_:
        return "grown" if adjoins else "new"
    return "shrunk" if adjoins else "gone"


def outline_of(points: Points, pixel: float) -> tuple[tuple[Place, ...], float, float]:
    """The convex outline of points on a surface, in their plane; their area and their width."""
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2][:2]
    flat = (points - middle) @ axes.T
    cells = np.floor((flat - flat.min(axis=0)) / pixel).astype(int) + 1
    taken = np.zeros(cells.max(axis=0) + 2, bool)
    taken[tuple(cells.T)] = True
    area = float(ndimage.binary_closing(taken, np.ones((2, 2))).sum()) * pixel**2
    corners = flat[ConvexHull(flat, qhull_options="QJ").vertices]
    corners = corners[:: len(corners) // MOST_CORNERS + 1]
    width = float(np.ptp(flat, axis=0).min()) + pixel
    return places_of((middle + corners @ axes).tolist()), area, width


HEADINGS = ("Place", "Kind", "First, °C", "Second, °C", "ΔT, K", "±", "Area", "x, y, z")
BANDS = {
    "difference_k": "K, the second date minus the first",
    "first_c": "°C",
    "second_c": "°C",
    "uncertainty_k": "K, half of the interval of the difference for 95 of 100 cases by photos and "
    "models alone",
}
"""Names of the bands of ``difference.tif``, and their units."""


def diff_runs(
    first: Run,
    second: Run,
    *,
    relative: bool = False,
    least_k: float = LEAST_K,
    scenes: tuple[Scene, Scene] | None = None,
) -> Differences:
    """Compare two runs of one object, such as before and after a repair: align the second with the
    first by the features of their photos, and find what has changed on the surface that both show.

    Args:
        first: the run of the earlier date; places are in its coordinates.
        second: the run of the later date, in any coordinates.
        relative: subtract the median change of the surface, such as by the weather.
        least_k: changes by less beside that median are not listed, K.
        scenes: that the runs were trained on, where they have been read before.

    Returns:
        What was found, also where nothing has changed.

    Raises:
        ConfigError: both are the same run, ``least_k`` is not above 0, or pycolmap of mrgs[sfm] is
            not installed.
        RunError: a run has no °C, or the runs show different modalities, do not overlap or cannot
            be aligned.
        SceneError: a scene or a photo cannot be read.
    """
    _check(first, second, least_k)
    scenes = scenes or (first.load_scene(), second.load_scene())
    shown = [" + ".join(map(str, scene.modalities)) for scene in scenes]
    if shown[0] != shown[1]:
        raise RunError(f"the runs show different modalities: {shown[0]}, and {shown[1]}")
    registration = register(first, second, scenes)
    marked = [open_marks(run, scene) for run, scene in zip((first, second), scenes, strict=True)]
    marks = marked[0].marks
    moved = replace(
        marks, marks=tuple(moved_mark(registration, each) for each in marks.marks), proposals=()
    )
    kept = {each.name for each in marks.marks if each.has_settings}
    ignored = [each.name for each in marked[1].marks.marks if each.has_settings]
    same = _same_camera(*scenes)
    dates = _Date(marked[0], marks, 1, same), _Date(marked[1], moved, 2, same)
    surface = Surface.of(dates, registration)
    comparison = _Comparison(dates, registration, surface, relative)
    found = (comparison.of_change(each, least_k) for each in surface.parts(least_k))
    certain = sorted((each for each in found if each and each[0] >= 1), key=lambda each: -each[0])
    taken = {each.name for each in marks.marks}
    names = (name for number in count(1) if (name := f"D{number}") not in taken)
    changes = tuple(
        each._replace(mark=replace(each.mark, name=name))
        for name, (_, each) in zip(names, certain, strict=False)
    )
    readings = (date.meter.measure(date.marks, date.regions) for date in dates)
    return Differences(
        registration,
        comparison.common_uncertainty,
        relative,
        least_k,
        changes,
        tuple(map(comparison.of_mark, *readings)),
        surface,
        dates,
        tuple(name for name in ignored if name not in kept),
    )


def facts_of(found: Compared, world: WorldFrame) -> dict[str, Any]:
    """A change or a mark by the columns of ``changes.csv``; None where there is no value."""
    x, y, z = np.mean(found.mark.points, axis=0).tolist()
    numbers = {
        "first_c": found.before,
        "second_c": found.after,
        "difference_k": found.difference,
        "uncertainty_k": found.uncertainty,
        "area_m2" if world.metric else "area_units2": found.area,
    }
    known = {name: None if math.isnan(value) else value for name, value in numbers.items()}
    place = {"x": x, "y": y, "z": z}
    return {"name": found.mark.name, "kind": found.kind, **known, **place, "problem": found.problem}


def columns(world: WorldFrame) -> list[str]:
    """The columns of ``changes.csv``."""
    nowhere = Mark("-", "spot", ((0.0, 0.0, 0.0),), (0.0, 0.0, 1.0), radius=1.0)
    return list(facts_of(Compared(nowhere, "spot", 0.0, 0.0, 0.0, 0.0), world))


def _row(found: Compared, t: Texts, world: WorldFrame) -> list[str]:
    """A change or a mark as the page lists it, under ``HEADINGS``."""

    def text(value: float, sign: bool = False) -> str:
        return DASH if math.isnan(value) else t.number(number_text(value, 1, sign=sign))

    around = found.uncertainty if math.isnan(found.uncertainty) else max(found.uncertainty, 0.1)
    area = DASH if math.isnan(found.area) else f"{digits(found.area)} {world.length_unit}²"
    numbers = text(found.before), text(found.after), text(found.difference, True), text(around)
    place = ", ".join(number_text(each, 2) for each in np.mean(found.mark.points, axis=0).tolist())
    texts = t.number(area), t.numbers(place), t(found.problem)
    return [found.mark.name, t(found.kind), *numbers, *texts]


def _difference_map(found: Differences) -> TemperatureMap | None:
    """The first run's map, if it has one, with ``BANDS``. SceneError if a photo cannot be read."""
    run, scene = found.dates[0].run, found.dates[0].scene
    if not has_map(scene):
        return None
    try:
        baked = bake(run.model, scene.train_cameras, run.temperature, run.device)
        shown = draw_temperature_map(baked, scene)
    except (ConfigError, RunError):
        return None
    points, known = shown.drawn.points, np.isfinite(shown.drawn.celsius)
    bands = np.full((len(BANDS), *known.shape), np.nan, np.float32)
    bands[:, known] = found.at(points[known].astype(np.float64))
    return replace(shown, drawn=replace(shown.drawn, bands=bands), unit="K")


def _geotiff(shown: TemperatureMap, found: Differences, folder: Path) -> list[Path]:
    """Write ``difference.tif``; returns its path, nothing if the first run is not in metres, which
    coordinate systems have, or rasterio is not installed."""
    scene, drawn = found.dates[0].scene, shown.drawn
    if not scene.world.metric:
        return []
    wkt = local_wkt(scene.name)
    with suppress(ConfigError):
        if not shown.from_the_front:
            wkt = coordinate_system(scene).wkt
        return [write_geotiff(folder / "difference.tif", drawn.grid, drawn.bands, BANDS, wkt, {})]
    return []


def _map_picture(shown: TemperatureMap, found: Differences, t: Texts) -> Image.Image:
    """The map with the outlines of changes and marks; in the middle of its scale is what has
    changed as most of the surface has."""
    middle = 0.0 if found.relative else found.common
    most = max(1.0, *np.abs(np.subtract(display_range(shown.drawn.celsius), middle)))
    marks = {each.mark.name: each.mark for each in (*found.changes, *found.marks)}
    return shown.picture(marks, Style("error", (middle - most, middle + most), t.decimal))
