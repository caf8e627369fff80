"""How well models show the hot cells of a solar plant: `python -m benchmarks.hot_cells RUN...`

Exports the map of each run (``mrgs export --format ortho``), looks for places that are hotter than
the row around them, and compares these with ``truth/defects.json`` of the plant that
``mrgs synth --scene solar-plant`` made. Prints a table.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import label, map_coordinates, maximum_filter, percentile_filter

from mrgs.export.write import export_run
from mrgs.maps.options import MapOptions
from mrgs.runs.open import load_run

PIXEL_M = 0.05

HALF_ROW_M = 3.5
"""A place is compared with the row to its left and with the row to its right, so far."""

FRAME_M = 0.25
"""The cool frames of modules do not count as the row: the warmest median so far to their sides
does."""

HOTTER_C = 2.0
"""Than the warmer of their medians: a hot place."""

NEAR_M = 0.3
"""A hot place belongs to a defect if its middle is at most so far outside of it."""


class HotPlace(NamedTuple):
    """A place that is hotter than the row around it: x and y in the scene (m), and by how many °C
    (the 90th percentile of its pixels)."""

    x: float
    y: float
    delta_c: float


class Found(NamedTuple):
    """A defect and what a map shows of it: its kind, the distance of the hot place from its middle
    (m; NaN if there is none), its ΔT and that of the hot place (°C)."""

    kind: str
    away_m: float
    true_c: float
    shown_c: float


def read_map(path: Path) -> tuple[Float[np.ndarray, "h w"], float, float]:
    """°C of a map, resampled to pixels of ``PIXEL_M`` along x and y of the scene, y upwards; x and
    y of its first pixel's middle."""
    import rasterio

    with rasterio.open(path) as file:
        celsius = file.read(1)
    facts = json.loads(path.with_name(f"{path.name}.json").read_text(encoding="utf-8"))
    corner, right, up = (
        np.array(facts[name])[:2]
        for name in ("map_corner_in_scene", "map_right_in_scene", "map_up_in_scene")
    )
    pixel = facts["pixel_m"]
    height, width = celsius.shape
    ends = [corner + pixel * (i * width * right + j * height * up) for i in (0, 1) for j in (0, 1)]
    low, high = np.min(ends, axis=0), np.max(ends, axis=0)
    x, y = (np.arange(a, b, PIXEL_M) for a, b in zip(low, high, strict=True))
    places = np.stack(np.meshgrid(x, y), axis=-1) - corner
    row, column = height - places @ up / pixel - 0.5, places @ right / pixel - 0.5
    known = np.isfinite(celsius)
    values = map_coordinates(np.where(known, celsius, 0.0), [row, column], order=1)
    weight = map_coordinates(known.astype(float), [row, column], order=1)
    return np.where(weight > 0.99, values, np.nan), float(x[0]), float(y[0])


def hot_places(celsius: Float[np.ndarray, "h w"], x0: float, y0: float) -> list[HotPlace]:
    """Hot places on rows of modules along x, which are warmer than the ground.

    Args:
        celsius: see ``read_map``.
        x0: x of the first pixel's middle.
        y0: y of the first pixel's middle.
    """
    limit = _between_ground_and_modules(celsius[np.isfinite(celsius)])
    known = np.where(np.isfinite(celsius), celsius, limit - 10.0)
    half = round(HALF_ROW_M / PIXEL_M)
    sides = [
        percentile_filter(known, 50, size=(1, half), origin=(0, shift), mode="nearest")
        for shift in (-(half // 2), half // 2 - 1 + half % 2)
    ]
    across = 2 * round(FRAME_M / PIXEL_M) + 1
    around = maximum_filter(np.maximum(*sides), size=(across, 1))
    excess = np.where(around > limit, known - around, 0.0)
    labels, count = label(excess > HOTTER_C)
    found = []
    for number in range(1, count + 1):
        row, column = np.nonzero(labels == number)
        weight = excess[row, column]
        x, y = (float(np.average(each, weights=weight)) for each in (column, row))
        found.append(HotPlace(x0 + PIXEL_M * x, y0 + PIXEL_M * y, float(np.percentile(weight, 90))))
    return found


def _between_ground_and_modules(celsius: Float[np.ndarray, " n"]) -> float:
    """The temperature halfway between those of the ground and of the modules (two means)."""
    limit = float(celsius.mean())
    for _ in range(20):
        limit = float(celsius[celsius < limit].mean() + celsius[celsius >= limit].mean()) / 2
    return limit


def compare(defects: list[dict], places: list[HotPlace]) -> tuple[list[Found], int]:
    """What hot places show of each defect, and how many of them are none."""
    found, explained = [], set()
    for defect in defects:
        middle, size = np.array(defect["position_m"][:2]), np.array(defect["size_m"])
        best = Found(defect["kind"], np.nan, defect["delta_c"], np.nan)
        for number, place in enumerate(places):
            offset = np.array([place.x, place.y]) - middle
            if (np.abs(offset) > size / 2 + NEAR_M).any():
                continue
            explained.add(number)
            away = float(np.linalg.norm(offset))
            if not away > best.away_m:  # NaN: the first
                best = best._replace(away_m=away, shown_c=place.delta_c)
        found.append(best)
    return found, len(places) - len(explained)


def report(path: Path) -> None:
    """Print a run's table."""
    run = load_run(path)
    scene = run.load_scene()
    truth = json.loads((Path(scene.path) / "truth/defects.json").read_text(encoding="utf-8"))
    (tif, *_) = export_run(run, path / "export", "ortho", maps=MapOptions(pixel_size_m=PIXEL_M))
    found, others = compare(truth["defects"], hot_places(*read_map(tif)))
    print(f"\n{path}: {others} hot places that are no defect\n")
    print("| | found | position error, median and largest | ΔT error, median (mean of its size) |")
    print("|---|---|---|---|")
    for kind in ("cell", "substring", "module"):
        those = [each for each in found if each.kind == kind]
        seen = [each for each in those if np.isfinite(each.away_m)]
        if not seen:
            print(f"| {kind} | 0 of {len(those)} | – | – |")
            continue
        away = np.array([each.away_m for each in seen])
        error = np.array([each.shown_c - each.true_c for each in seen])
        print(
            f"| {kind} | {len(seen)} of {len(those)} | {100 * np.median(away):.1f} cm, "
            f"{100 * away.max():.1f} cm | {np.median(error):+.2f} °C ({np.abs(error).mean():.2f}) |"
        )


def main() -> None:
    """The command line."""
    for name in sys.argv[1:]:
        report(Path(name))


if __name__ == "__main__":
    main()
