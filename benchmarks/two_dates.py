"""How well `mrgs diff` finds known changes: `python -m benchmarks.two_dates FOLDER SEED...`

FOLDER has for each seed the scenes ``aSEED`` and ``bSEED``, which ``python -m benchmarks.two_dates
FOLDER SEED:KIND ...`` generates (KIND of ``mrgs synth --scene``), and the runs ``raSEED`` and
``rbSEED`` that ``mrgs train`` trained on them. Prints what was found of the known
changes, which of the reported ones are none, how well the runs were aligned, and how often the ± of
ΔT of changes and of random spots holds the truth.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float64
from PIL import Image

from mrgs.errors import ConfigError
from mrgs.marks import open_marks
from mrgs.marks.mark import Mark, Marks
from mrgs.report.changes import REACH_PX, Differences, diff_runs
from mrgs.runs.open import load_run
from mrgs.scene import THERMAL, Camera, Scene

SPOTS = 40
"""Spots at random places of a scene."""

TRUE_SHARE = 0.5
"""A reported change is one if the truth there is at least this share of the least change, K."""


class Truth(NamedTuple):
    """Exact °C on both dates and z-depths of the first date's photos."""

    cameras: list[Camera]
    before: list[np.ndarray]
    after: list[np.ndarray]
    depth: list[np.ndarray]

    @classmethod
    def of(cls, folder: Path, scene: Scene) -> Truth:
        """The truth of the scene's training photos."""
        views = [view for view in scene.train if THERMAL in view.images]

        def read(kind: str) -> list[np.ndarray]:
            return [_tiff(folder / f"truth/{kind}/{view.name}.tiff") for view in views]

        cameras = [view.images[THERMAL].camera for view in views]
        return cls(cameras, read("temperature"), read("after"), read("depth"))

    def at(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "2 n"]:
        """Exact °C of points on both dates, the mean over the photos that see them; else NaN."""
        total, count = np.zeros((2, len(points))), np.zeros(len(points))
        for camera, *images in zip(*self, strict=True):
            pixels, z = camera.project(torch.from_numpy(points))
            inside = camera.contains(pixels).numpy()
            column, row = pixels[inside].long().numpy().T
            near = np.abs(images[2][row, column] - z[inside].numpy()) < 0.03 * z[inside].numpy()
            rows = np.flatnonzero(inside)[near]
            total[:, rows] += np.stack([each[row[near], column[near]] for each in images[:2]])
            count[rows] += 1
        with np.errstate(invalid="ignore"):
            return total / count


def _tiff(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image, dtype=np.float64)


class Outcome(NamedTuple):
    """What was found in a scene: known changes and those found; reported changes, and the false
    ones; (error, ±) of the changes' and the spots' ΔT beside the common change, and of that."""

    known: list[str]
    missed: list[str]
    reported: int
    false: list[str]
    kinds: tuple[int, int]
    changes: list[tuple[float, float]]
    spots: list[tuple[float, float]]
    common: tuple[float, float]


def compare(folder: Path, seed: str, least_k: float = 1.0) -> Outcome:
    """Compare the two runs of a seed with the truth."""
    runs = load_run(folder / f"ra{seed}"), load_run(folder / f"rb{seed}")
    scenes = runs[0].load_scene(), runs[1].load_scene()
    truth = Truth.of(folder / f"a{seed}", scenes[0])
    facts = json.loads((folder / f"a{seed}/truth/changes.json").read_text())
    marks = open_marks(runs[0], scenes[0])
    marks.store.edit(lambda old: Marks(tuple(_spots(marks, int(seed)))))
    found = diff_runs(*runs, relative=True, least_k=least_k, scenes=scenes)
    exact = truth.at(found.surface.points)
    common = float(np.nanmedian(exact[1] - exact[0]))
    _print_alignment(seed, found, facts["second_from_first"][0], common)
    return _outcome(found, truth, facts["changes"], common, least_k)


def _outcome(
    found: Differences,
    truth: Truth,
    changes: list[dict[str, Any]],
    common: float,
    least: float,
) -> Outcome:
    exact = truth.at(found.surface.points)
    beside = exact[1] - exact[0] - common
    wanted = [each for each in changes if _is_large(each, found, beside, least)]
    hit: dict[int, list[str]] = {}
    false, errors = [], []
    for change in found.changes:
        assert change.places is not None
        exact = truth.at(change.places)
        true = float(np.nanmean(exact[1] - exact[0]))
        text = (
            f"{change.mark.name} {change.kind} {change.difference:+.2f} ± {change.uncertainty:.2f},"
            f" truth {true - common:+.2f}, {len(change.places)} places"
            f" at {np.round(change.places.mean(axis=0), 2).tolist()}"
        )
        if not (true - common) * np.sign(change.difference) >= TRUE_SHARE * least:
            false.append(text)
        errors.append((change.difference - (true - common), change.uncertainty))
        for number, each in enumerate(wanted):
            radius = max(each["before"]["radius_m"], each["after"]["radius_m"])
            distance = np.linalg.norm(change.places - each["center"], axis=1)
            step = each["after"]["kelvin"] - each["before"]["kelvin"]
            sign = step or each["after"]["kelvin"] * (
                each["after"]["radius_m"] - each["before"]["radius_m"]
            )
            reach = radius + REACH_PX * found.surface.pixel
            if np.median(distance) < reach and sign * change.difference > 0:
                hit.setdefault(number, []).append(change.kind)
        print("   ", text)
    spots = []
    for mark in found.marks:
        exact = truth.at(np.array(mark.mark.points))[:, 0]
        spots.append((mark.difference - (exact[1] - exact[0] - common), mark.uncertainty))
    names = [_name(each) for each in wanted]
    missed = [name for number, name in enumerate(names) if number not in hit]
    right = sum(wanted[number]["kind"] in kinds for number, kinds in hit.items())
    return Outcome(
        names, missed, len(found.changes), false, (right, len(hit)),
        errors, spots, (found.common - common, found.common_uncertainty),
    )  # fmt: skip


def _is_large(change: dict[str, Any], found: Differences, beside: np.ndarray, least: float) -> bool:
    """Whether a patch has changed by the least change or more, as an ideal camera sees it: the mean
    of its places with at least half of the largest change."""
    if change["kind"] == "same":
        return False
    radius = 1.2 * max(change["before"]["radius_m"], change["after"]["radius_m"])
    near = np.linalg.norm(found.surface.points - change["center"], axis=1) < radius
    values = beside[near & np.isfinite(beside)]
    if not len(values):
        return False
    values = values * np.sign(values[np.abs(values).argmax()])
    large = bool(values[values >= 0.5 * np.quantile(values, 0.95)].mean() >= least)
    if not large:
        print("    not counted, below the least change:", _name(change))
    return large


def _name(change: dict[str, Any]) -> str:
    before, after = change["before"], change["after"]
    return (
        f"{change['kind']} on {change['solid']} at {np.round(change['center'], 2).tolist()}: "
        f"{before['kelvin']:+.1f} K, {before['radius_m']:.2f} m -> {after['kelvin']:+.1f} K, "
        f"{after['radius_m']:.2f} m"
    )


def _spots(marks: Any, seed: int) -> list[Mark]:
    """Spots at random pixels of the training photos."""
    rng = np.random.default_rng([seed, 71])
    cameras = [photo.camera for photo in marks.scene.train_photos(THERMAL)]
    found: list[Mark] = []
    for _ in range(20 * SPOTS):
        camera = cameras[int(rng.integers(len(cameras)))]
        pixel = rng.uniform([4, 4], [camera.width - 4, camera.height - 4])
        try:
            fields = marks._picker.pick("spot", camera, [pixel])
        except ConfigError:
            continue
        found.append(Mark(f"S{len(found) + 1}", "spot", **fields))
        if len(found) == SPOTS:
            break
    return found


def _print_alignment(seed: str, found: Differences, exact: dict[str, Any], common: float) -> None:
    points = found.surface.points
    target = exact["scale"] * points @ np.array(exact["rotation"]).T + np.array(exact["shift"])
    off = np.linalg.norm(found.registration(points) - target, axis=1) / exact["scale"]
    r = found.registration
    print(
        f"{seed}: {r.matches} matches, residual {r.residual:.3f} m, off {np.median(off):.3f} m "
        f"(median), overlap {r.overlap:.2f}, {len(points)} places; common {found.common:+.2f} "
        f"± {found.common_uncertainty:.2f} K, truth {common:+.2f}"
    )


def _held(errors: list[tuple[float, float]]) -> str:
    known = np.abs(np.array(errors).reshape(-1, 2))
    off, around = known[np.isfinite(known).all(axis=1)].T
    return (
        f"{100 * (off <= around).mean():.1f} % of {len(off)} held (± {np.median(around):.2f} K, "
        f"error {np.median(off):.2f} K, medians)"
    )


def _generate(folders: tuple[Path, Path], kind: str, seed: int) -> None:
    if kind == "solar-plant":
        from mrgs_synth.solar_plant import PlantOptions, synthesize_mornings

        size = {"width": 640, "height": 480}  # 2.5 cm per pixel; the standard asks for 3
        synthesize_mornings(*folders, PlantOptions(2, 16, eval_views=2, seed=seed, **size))
    else:
        from mrgs_synth.dates import synthesize_dates

        synthesize_dates(*folders, scene=kind, seed=seed)


def main(arguments: list[str]) -> None:
    """Generate scenes, or compare the runs of all seeds and print the sums."""
    folder, outcomes = Path(arguments[0]), []
    for argument in arguments[1:]:
        seed, _, kind = argument.partition(":")
        if kind:
            _generate((folder / f"a{seed}", folder / f"b{seed}"), kind, int(seed))
            continue
        outcome = compare(folder, seed)
        for text in outcome.missed:
            print("    missed:", text)
        for text in outcome.false:
            print("    false:", text)
        outcomes.append(outcome)
    if outcomes:
        _print_sums(outcomes)


def _print_sums(outcomes: list[Outcome]) -> None:
    known = sum(len(each.known) for each in outcomes)
    missed = sum(len(each.missed) for each in outcomes)
    reported = sum(each.reported for each in outcomes)
    false = sum(len(each.false) for each in outcomes)
    right, hits = np.sum([each.kinds for each in outcomes], axis=0)
    print(f"found {known - missed} of {known}; {false} of {reported} reported are false")
    print(f"kind right for {right} of {hits}")
    missed_kinds = Counter(text.split()[0] for each in outcomes for text in each.missed)
    print("missed kinds:", dict(missed_kinds))
    for name in ("changes", "spots"):
        print(f"{name}: {_held([each for one in outcomes for each in getattr(one, name)])}")
    print(f"common change: {_held([each.common for each in outcomes])}")


if __name__ == "__main__":
    main(sys.argv[1:])
