"""The modules of a photovoltaic plant: how warm each is against its neighbours in the row, what
that is by IEC TS 62446-3, and what power is lost. ``docs/modules.md`` has the sources."""

from __future__ import annotations

import datetime
import math
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float64, Int64
from scipy import ndimage

from mrgs.errors import ConfigError, RunError
from mrgs.maps.crs import LOCAL, require_metres
from mrgs.maps.draw import draw_map
from mrgs.maps.modules import find_modules
from mrgs.maps.options import MapOptions
from mrgs.maps.surfaces import grid_from_above, median_distance, seen_surfaces
from mrgs.marks.mark import Mark, places_of
from mrgs.marks.measure import NARROW_HOT, NO_PHOTO
from mrgs.marks.photo_readings import COVERAGE, OF_POINT, PhotoReadings, SightingSums
from mrgs.marks.resolution import RESOLVED_PX
from mrgs.marks.tables import DASH, write_features, write_rows
from mrgs.marks.uncertainty import Budget, shared_difference
from mrgs.pictures.files import write_png
from mrgs.pictures.html import PAGE_STYLE, inline_image, write_html
from mrgs.report.copies import require_packages, write_copies
from mrgs.report.overview import Style, TemperatureMap, faces_one_side, has_map
from mrgs.report.sections import LEAST_W_M2, MOST_PIXEL_CM
from mrgs.report.texts import Language, Texts
from mrgs.runs.baked import bake
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Scene
from mrgs.scene.depth_map import ENOUGH, visible
from mrgs.survey import SURVEY_FILE, Survey, read_survey
from mrgs.system.wording import number_text

Values: TypeAlias = Float64[np.ndarray, " m"]

SIZES_M, POWERS_W, YIELDS = (0.3, 3.0), (1.0, 2000.0), (100.0, 3000.0)
"""What modules may have: sides, power, and energy of a year, kWh by kW of power."""

NOMINAL_W_M2 = 1000.0
"""Irradiance to which ΔT is normalised."""

FINEST, COARSEST = 1 / 40, 1 / 8
"""Pixels of the map and of the photos, as shares of a module's shorter side."""

EDGE_M, CELLS, SLACK_M = 0.07, 6, 2.0
"""The frame, and what blur mixes with it; cells along the shorter side of a module; and how far
from its plane a model may show glass, which has no texture."""

SHOWN = 0.4
"""Share of a cell's width over which it is measured: the rest is mixed with its neighbours."""

OF_READING = OF_POINT._replace(deviation=1.0)
"""Photos that differ from the model show that it has not resolved the place."""

LEAST_CELL_K, LEAST_PART_K = 3.0, 2.0
"""Smallest ΔT of a hot cell beside its third, and of a third or a module beside the neighbours."""

LIMITS_K, LOSSES = (10.0, 20.0), (0.15, 0.3, 0.6)
"""ΔT at 1,000 W/m² from which on a hot cell is of class 2, and any finding of class 3; and the
shares of a module's power that a hot cell costs below, between and above."""

BESIDE = 8
"""Places to both sides in the row with which a module is compared."""

PARTS = "", "hot third", "two hot thirds", "hot module"
SPOTS = "", "hot cell", "several hot cells"
NUMBERS = "celsius", "delta_k", "uncertainty_k", "delta_1000_k", "hottest_c", "lost_w", "lost_kwh"


@dataclass(frozen=True, eq=False)
class ModuleTable:
    """The modules of a plant and what was measured of them, by their number; °C and K, NaN where
    too few photos look. ``names`` are such as R2.1-14, row 2, line 1, place 14;
    ``corners`` in scene coordinates, [M, 4, 3]; ``rows`` the columns of the table without both;
    ``sides`` those of most modules along the row and across it, ``pixel`` the width of the photos'
    pixels on them, metres; ``power_w`` that of a module at 1,000 W/m², and ``yield_kwh`` the energy
    of a year by kW of it, None if not stated."""

    scene: Scene
    shown: TemperatureMap
    names: tuple[str, ...]
    corners: Float64[np.ndarray, "m 4 3"]
    rows: tuple[dict[str, Any], ...]
    sides: tuple[float, float]
    pixel: float
    survey: Survey
    power_w: float | None
    yield_kwh: float | None
    notes: tuple[str, ...]

    @property
    def findings(self) -> list[int]:
        """Numbers of the modules that are not sound, the most severe and hottest first."""
        found = [n for n, row in enumerate(self.rows) if row["finding"]]
        return sorted(found, key=lambda n: (-self.rows[n]["class"], -self.rows[n]["delta_k"]))

    def write(self, folder: str | Path, language: Language = "en", pdf: bool = False) -> list[Path]:
        """Write ``modules.html``, ``modules.csv``, ``modules.geojson``, ``modules.png`` and the
        page as PDF into a folder; returns the paths. ConfigError if weasyprint is not installed,
        RunError if a file cannot be written."""
        require_packages(pdf)
        folder, t = Path(folder), Texts(language)
        facts = [
            {"name": name, **row, **dict(zip("xyz", corners.mean(axis=0).tolist(), strict=True))}
            for name, row, corners in zip(self.names, self.rows, self.corners, strict=True)
        ]
        found, eye = self.findings, tuple(self.scene.train[0].camera.position.tolist())
        marks = [
            Mark(name, "polygon", places_of(corners.tolist()), eye)
            for name, corners in zip(self.names, self.corners, strict=True)
        ]
        chosen = {marks[n].name: marks[n] for n in found}
        picture = self.shown.picture(chosen, Style(decimal=t.decimal))

        def total(name: str) -> str:
            """The thousands that all modules have together; empty where none has the number."""
            known = [row[name] for row in self.rows if row[name] is not None]
            return t.number(f"{sum(known) / 1000:.2f}") if known else ""

        page = write_html(
            folder / "modules.html",
            "report/modules.html",
            title=t("{name}: modules", name=self.scene.name),
            subtitle=t.date(datetime.date.today()),
            styles=[PAGE_STYLE, "report/report.css"],
            language=language,
            t=t,
            table=self,
            notes=[t(note) for note in self.notes],
            counts=Counter(row["class"] for row in self.rows),
            least_w_m2=LEAST_W_M2,
            most_pixel_m=MOST_PIXEL_CM / 100,
            figure=inline_image(picture, t("modules with findings"), png=True),
            listed=[facts[n] for n in found],
            number=lambda value, sign=False, decimals=1: (
                DASH if value is None else t.number(number_text(value, decimals, sign=sign))
            ),
            size=t.number(" × ".join(f"{side:.2f}" for side in self.sides)),
            pixel=t.number(f"{100 * self.pixel:.1f}"),
            lost=total("lost_w"),
            energy=total("lost_kwh"),
        )
        csv = write_rows(folder / "modules.csv", list(facts[0]), facts)
        features = zip(facts, marks, strict=True)
        geojson = write_features(folder / "modules.geojson", features, self.scene.world)
        png = write_png(folder / "modules.png", picture)
        return [page, csv, geojson, png, *write_copies(page, pdf)]


def module_table(
    run: Run,
    size_m: tuple[float, float],
    power_w: float | None = None,
    yield_kwh: float | None = None,
    scene: Scene | None = None,
) -> ModuleTable:
    """Find and measure the modules of a plant.

    Args:
        run: of photos that look down on the plant.
        size_m: the sides of a module, in any order.
        power_w: of a module at 1,000 W/m².
        yield_kwh: energy that a kW of sound modules gives in a year, kWh.
        scene: that the run was trained on, where it has been read before.

    Raises:
        ConfigError: a number that modules do not have, or the scene is not in metres.
        RunError: the run has no °C, its photos do not look down or are too coarse, or there are no
            modules of this size.
        SceneError: the scene or a photo cannot be read.
    """
    if not all(SIZES_M[0] <= side <= SIZES_M[1] for side in size_m):
        raise ConfigError(
            "a module's sides are 0.3 to 3 m, such as 1.05 and 1.75", options=("module",)
        )
    if power_w is not None and not POWERS_W[0] <= power_w <= POWERS_W[1]:
        raise ConfigError(f"a module's power is 1 to 2,000 W, not {power_w:g}", options=("power",))
    if yield_kwh is not None and power_w is None:
        raise ConfigError(
            "lost energy needs the power of a module too", options=("power", "yield_kwh")
        )
    if yield_kwh is not None and not YIELDS[0] <= yield_kwh <= YIELDS[1]:
        raise ConfigError(
            f"a kW of modules gives 100 to 3,000 kWh in a year, not {yield_kwh:g}",
            options=("yield_kwh",),
        )
    path = run.folder.path
    if run.temperature is None or THERMAL not in run.modalities:
        raise RunError(f"{path} has no temperatures in °C: train it on thermal photos in °C")
    scene, survey = scene or run.load_scene(), read_survey(path / SURVEY_FILE)
    require_metres(scene)
    if not has_map(scene) or faces_one_side(scene):
        raise RunError(
            f"the photos of {scene.name} do not look down: photograph a plant from above"
        )
    every, scene = scene, replace(scene, train=scene.survey_views(THERMAL))
    enough = ENOUGH if len(scene.train) < len(every.train_photos(THERMAL)) else math.inf
    baked = bake(run.model, scene.train_cameras, run.temperature, run.device)
    maps = seen_surfaces(baked, scene)
    focal = np.median([photo.camera.focal_px for photo in scene.train_photos(THERMAL)])
    pixel, least = median_distance(maps) / float(focal), min(size_m)
    if pixel > COARSEST * least:
        raise RunError(
            f"a pixel of the thermal photos is {100 * pixel:.0f} cm wide, a module {least:g} m: "
            f"photograph the plant from nearer"
        )
    options = MapOptions(pixel_size_m=max(pixel, FINEST * least))
    grid, coverage = grid_from_above(scene, maps, LOCAL, options, enough=enough)
    drawn = draw_map(baked, scene, maps, grid, None, coverage)
    found = find_modules(
        drawn.celsius, drawn.bands[1:4], drawn.points @ grid.axes[2].astype(np.float32),
        grid.pixel_m, size_m,
    )  # fmt: skip
    corners = (found.corners + np.array([grid.left, grid.top, 0.0])) @ grid.axes
    seen = _Seen.by_photos(run, scene, corners, pixel)
    budget, irradiance = Budget.of(scene, survey), survey.irradiance_w_m2
    rows = tuple(_judged(seen, found.numbers, budget, irradiance, power_w, yield_kwh, pixel))
    names = tuple(f"R{row}.{line}-{place}" for row, line, place in found.numbers.tolist())
    width, height = found.sides.tolist()
    shown = TemperatureMap(drawn, False, scene.world.north)
    sides, notes = (width, height), budget.notes
    return ModuleTable(
        scene, shown, names, corners, rows, sides, pixel, survey, power_w, yield_kwh, notes
    )


@dataclass(frozen=True, eq=False)
class _Seen:
    """What photos read on M modules, [M, L, S], along their longer and their shorter sides without
    the frame: °C without the camera's blur and drift as far as the model knows them, NaN where none
    looks, and uncertainty, K; how many photos look; and the distance of two places, metres."""

    celsius: Float64[np.ndarray, "m l s"]
    around: Float64[np.ndarray, "m l s"]
    photos: Values
    step: float

    @classmethod
    def by_photos(
        cls, run: Run, scene: Scene, corners: Float64[np.ndarray, "m 4 3"], pixel: float
    ) -> _Seen:
        """Look at all modules photo by photo. SceneError if a photo cannot be read."""
        first, sides = corners[:, 0], corners[:, (3, 1)] - corners[:, :1]
        lengths = np.median(np.linalg.norm(sides, axis=2), axis=0)
        sides, lengths = sides[:, np.argsort(-lengths)], np.sort(lengths)[::-1]
        step = max(pixel, lengths[1] * FINEST)
        counts = np.ceil((lengths - 2 * EDGE_M) / step).astype(int)
        shares = [
            np.linspace(EDGE_M / length, 1 - EDGE_M / length, count)
            for length, count in zip(lengths, counts, strict=True)
        ]
        at = np.stack(np.meshgrid(*shares, indexing="ij"), axis=-1)
        points = (first[:, None, None] + at @ sides[:, None]).astype(np.float32)
        size, middles = at[..., 0].size, points.mean(axis=(1, 2))
        readings = PhotoReadings(run.render, run.camera_response, scene.train, run.temperature)
        sums = SightingSums(len(points) * size)
        for view in scene.train:
            camera = view.images[THERMAL].camera
            near = visible(camera, middles).rows
            if len(near):
                photo = readings.witness(view, camera.width)
                rows, pixels, z = photo.shown(points[near].reshape(-1, 3), 0.0, SLACK_M)
                sums.add(near[rows // size] * size + rows % size, photo.image[pixels], z)
        shape, total = points.shape[:3], sums.parts(OF_READING, sums.rendered).total
        photos = np.median(sums.photos.reshape(len(points), -1), axis=1)
        celsius, around = (each.reshape(shape).astype(float) for each in (sums.readings, total))
        return cls(celsius, around, photos, float(step))


def _beside(whole: Values, numbers: Int64[np.ndarray, "m 3"]) -> tuple[Values, Values]:
    """The median temperature of the neighbours in the row of each module, and half of the interval
    of 95 of 100 of them; where there are few, of the row, and of the plant."""
    found = np.empty((2, len(whole)))
    for n, (row, _, place) in enumerate(numbers):
        others = np.isfinite(whole) & (np.arange(len(whole)) != n)
        in_row = others & (numbers[:, 0] == row)
        near = in_row & (np.abs(numbers[:, 2] - place) <= BESIDE)
        chosen = next((each for each in (near, in_row) if each.sum() > 3), others)
        values = whole[chosen]
        found[0, n] = np.nanmedian(values)
        found[1, n] = COVERAGE * np.nanmedian(np.abs(values - found[0, n])) / 0.6745
    return found[0], found[1]


class _Finding(NamedTuple):
    """What is hot in a module: °C of the hottest cell, else of the least hot of the hot thirds,
    else of the whole, with its own uncertainty, K; °C of the hottest place; how many thirds and
    cells are hot; and the width of the hottest cell, metres, infinite without one."""

    celsius: float
    own: float
    hottest_c: float
    thirds: int
    cells: int
    width: float


def _findings(seen: _Seen, whole: Values, doubt: Values, beside: Values) -> Iterator[_Finding]:
    """The finding in each module, by the temperatures of the whole and their uncertainty, and those
    of the modules beside it."""
    parts = np.array_split(seen.celsius, 3, axis=2)
    thirds = np.stack([np.nanmedian(each, axis=(1, 2)) for each in parts], axis=1)
    usual = np.repeat(thirds, [each.shape[2] for each in parts], axis=1)[:, None]
    usual = ndimage.maximum_filter1d(usual, 5, axis=2)  # the edge of a hot third is not a cell
    excess = np.nan_to_num(seen.celsius - usual)
    smooth = _mean_over(excess, SHOWN * seen.celsius.shape[2] / CELLS)
    for n, cells in enumerate(smooth):
        at = np.unravel_index(int(cells.argmax()), cells.shape)
        hottest = float(usual[n, 0, at[1]] + cells[at])
        hot = int((thirds[n] - beside[n] >= LEAST_PART_K).sum())
        spots, count = ndimage.label(cells > max(LEAST_CELL_K, cells[at] / 2))
        if count:
            width = seen.step * float(np.sqrt((spots == spots[at]).sum()))
            yield _Finding(hottest, float(seen.around[n][at]), hottest, hot, count, width)
        else:
            warmest = np.sort(thirds[n][np.isfinite(thirds[n])])[::-1]
            celsius = float(warmest[hot - 1] if hot else whole[n])
            yield _Finding(celsius, float(doubt[n]), hottest, hot, 0, math.inf)


def _judged(
    seen: _Seen,
    numbers: Int64[np.ndarray, "m 3"],
    budget: Budget,
    irradiance: float | None,
    power_w: float | None,
    yield_kwh: float | None,
    pixel: float,
) -> Iterator[dict[str, Any]]:
    """The columns of the table for each module."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # modules that no photo sees
        whole, doubt = (np.nanmedian(each, axis=(1, 2)) for each in (seen.celsius, seen.around))
        beside, spread = _beside(whole, numbers)
        findings = [*_findings(seen, whole, doubt, beside)]
    known = np.isfinite(seen.celsius).mean(axis=(1, 2)) > 0.5
    watts = kwh = None
    if irradiance is not None and power_w is not None:
        watts = power_w * irradiance / NOMINAL_W_M2
        kwh = None if yield_kwh is None else power_w * yield_kwh / 1000
    factor = None
    if irradiance is not None and irradiance >= LEAST_W_M2:
        factor = NOMINAL_W_M2 / irradiance
    for n, (line_of, found) in enumerate(zip(numbers.tolist(), findings, strict=True)):
        delta = found.celsius - float(beside[n])
        shared = _of_difference(budget, found.celsius, float(beside[n]))
        normalised = None if factor is None else factor * delta
        judged = delta if normalised is None else normalised
        level = int(np.searchsorted(LIMITS_K, np.nan_to_num(judged), "right"))
        is_hot = found.thirds or (found.cells and level)
        lost = max(found.thirds / 3, LOSSES[level] if found.cells else 0.0)
        row: dict[str, Any] = {
            "row": line_of[0], "line": line_of[1], "place": line_of[2],
            "finding": ", ".join(filter(None, (PARTS[found.thirds], SPOTS[min(found.cells, 2)]))),
            "class": (3 if level == 2 else 2) if is_hot else 1,
            "celsius": float(whole[n]), "delta_k": delta,
            "uncertainty_k": math.hypot(found.own, spread[n], shared),
            "delta_1000_k": normalised, "hottest_c": found.hottest_c,
            "lost_w": None if watts is None else lost * watts,
            "lost_kwh": None if kwh is None else lost * kwh,
            "photos": int(seen.photos[n]),
            "remark": NARROW_HOT if found.width < RESOLVED_PX * pixel else "",
        }  # fmt: skip
        if not known[n] or math.isnan(delta):
            row |= dict.fromkeys(NUMBERS) | {"finding": "", "class": None, "remark": NO_PHOTO}
        yield {name: None if value != value else value for name, value in row.items()}


def _mean_over(values: Float64[np.ndarray, "m l s"], width: float) -> Float64[np.ndarray, "m l s"]:
    """Means over squares of so many places, at least one, and parts of places."""
    width = max(width, 1.0)
    reach = math.ceil((width - 1) / 2)
    weights = ((width + 1) / 2 - np.abs(np.arange(-reach, reach + 1))).clip(0, 1) / width
    for axis in (1, 2):
        values = ndimage.correlate1d(values, weights, axis, mode="nearest")
    return values


def _of_difference(budget: Budget, celsius: float, beside: float) -> float:
    """What camera and settings contribute to the uncertainty of ΔT: they are the same at both
    places, but for the camera's unevenness."""
    surface = budget.capture.surface
    hot, cold = (
        {
            quantity: float(part[0])
            for quantity, part in budget.contributions(np.array([each]), surface, place).items()
        }
        for place, each in enumerate((celsius, beside))
    )
    return math.hypot(*shared_difference(hot, cold).values())
