"""``mrgs measure``: marks from the command line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from mrgs.app.commands import Measure
from mrgs.app.terminal import cropped, note_unfinished, print_note
from mrgs.errors import ConfigError
from mrgs.marks import MarkReading, RunMarks, open_marks
from mrgs.marks.mark import KINDS, MarkKind
from mrgs.marks.tables import HEADINGS, text_rows, write_csv, write_geojson
from mrgs.pictures.values import unit_of
from mrgs.runs.open import load_run
from mrgs.scene import THERMAL, Camera
from mrgs.system.wording import aligned

_NUMBER = r"([0-9]+(?:\.[0-9]*)?|\.[0-9]+)"
_CORNER = f"{_NUMBER},{_NUMBER}"


def measure(command: Measure) -> None:
    """Change the marks of a run as the options say, then list and export them. Errors as for
    ``RunMarks``; also ConfigError if an option cannot be understood, or two exclude each other."""
    added = [kind for kind in KINDS if getattr(command, kind)]
    _check(command, added)
    run = cropped(load_run(command.run, command.scene, command.device))
    note_unfinished(run)
    marks = open_marks(run)
    if command.undo:
        marks.undo()
    if command.delete is not None:
        marks.remove(command.delete)
    for name in command.drop:
        marks.drop(name)
    changes = _changes(command)
    for kind in added:
        camera, pixels = _places(getattr(command, kind), kind, marks)
        if kind != "box":
            marks.add(kind, camera, pixels, **changes)
        elif len(pixels) == 2:
            marks.box(camera, pixels[0], pixels[1], **changes)
        else:
            raise ConfigError("--box has two corners: VIEW:X,Y X,Y")
    for name in command.accept:
        marks.accept(name, **changes)
    if command.mark is not None:
        marks.change(command.mark, **changes)
    if command.reference is not None:
        name, given, celsius = command.reference.rpartition("=")
        if not given:
            marks.refer_to(command.reference)
        elif not re.fullmatch(f"-?{_NUMBER}", celsius.strip()):
            raise ConfigError(f"--reference {command.reference}: write MARK=°C, such as S1=12.4")
        else:
            for _ in range(2):  # once more for the share of the mark that is not quite opaque
                marks.calibrate(name.strip(), float(celsius))
                marks = open_marks(load_run(command.run, command.scene, command.device).cropped())
    _show(command, marks)


def _check(command: Measure, added: Sequence[MarkKind]) -> None:
    if len(added) > 1:
        raise ConfigError(f"one mark at a time: give only one of --{' and --'.join(added)}")
    if len(command.spot) > 1:
        raise ConfigError("--spot has one place, VIEW:X,Y; run the command once for each spot")
    if (added or command.accept) and command.mark is not None:
        raise ConfigError("--mark changes a mark that is there: leave it out to add or accept one")
    if added and command.accept:
        raise ConfigError(f"give either --accept or --{added[0]}")
    if _changes(command) and not added and not command.accept and command.mark is None:
        raise ConfigError("say which mark to change with --mark, or add one")


def _changes(command: Measure) -> dict[str, Any]:
    """The fields of the mark that the options set."""
    given = {
        "name": command.name,
        "note": command.note,
        "severity": command.severity,
        "against": command.against,
        "emissivity": command.emissivity,
        "reflected_c": command.reflected,
    }
    return {name: value for name, value in given.items() if value is not None}


def _places(
    texts: Sequence[str], kind: MarkKind, marks: RunMarks
) -> tuple[Camera, list[tuple[float, float]]]:
    """The camera and the pixels that VIEW:X,Y X,Y ... names."""
    view_name, _, first = texts[0].rpartition(":")
    corners = [re.fullmatch(_CORNER, text) for text in (first, *texts[1:])]
    if not view_name or not all(corners):
        raise ConfigError(f"--{kind} {' '.join(texts)}: write VIEW:X,Y, then X,Y for each corner")
    if marks.scene is None:
        raise ConfigError("the scene is not there, so its views have no names; give --scene")
    views = {view.name: view for view in (*marks.scene.train, *marks.scene.eval)}
    if view_name not in views:
        raise ConfigError(f"there is no view {view_name!r}; the first is {next(iter(views))}")
    cameras = views[view_name].cameras
    camera = cameras.get(THERMAL, views[view_name].camera)
    return camera, [(float(found[1]), float(found[2])) for found in corners if found]


def _show(command: Measure, marks: RunMarks) -> None:
    readings, temperature = marks.measure(), marks.run.temperature
    if readings:
        _print_table(readings, marks, "Mark")
    else:
        print("no marks yet: add one with --spot VIEW:X,Y, or in mrgs view")
    proposals = marks.measure_proposals()
    if proposals:
        print()
        _print_table(proposals, marks, "Proposed")
        first = proposals[0].mark.name
        print(f"judge what the report proposes: --accept {first}, or --drop {first}")
    assumed = [text for each in (*readings, *proposals) for text in marks.assumptions_of(each)]
    for text in dict.fromkeys(map(str, assumed)):
        print_note(text)
    written = readings, temperature, marks.world, marks.assumptions_of
    if command.csv is not None:
        for path in write_csv(command.csv, *written):
            print(f"csv: {path}")
    if command.geojson is not None:
        print(f"geojson: {write_geojson(command.geojson, *written)}")


def _print_table(readings: Sequence[MarkReading], marks: RunMarks, title: str) -> None:
    temperature = marks.run.temperature
    named = {"Mark": title, "Mean": f"Mean, {unit_of(THERMAL, temperature)}"}
    headings = tuple(named.get(name, name) for name in HEADINGS)
    rows = [headings, *text_rows(readings, temperature, marks.world)]
    print("\n".join(aligned(rows, {0, 1, len(headings) - 2, len(headings) - 1})))
