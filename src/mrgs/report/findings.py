"""What was measured and what was found in a run, as the report shows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from PIL import Image

from mrgs.marks import RunMarks
from mrgs.marks.mark import Mark
from mrgs.marks.regions import Regions
from mrgs.marks.tables import value_text
from mrgs.pictures.html import InlineImage, inline_image
from mrgs.pictures.numbers import number_text
from mrgs.pictures.values import in_unit
from mrgs.report.conditions import pixel_cm_text
from mrgs.report.marks import ShownMark, show_marks
from mrgs.report.pictures import overviews
from mrgs.report.plan import Plan, TemperatureMap, temperature_map
from mrgs.report.proposals import Anomaly
from mrgs.report.spots import photo_value
from mrgs.report.texts import Texts
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Scene, TemperatureRange
from mrgs.survey import Survey


class ShownOverview(NamedTuple):
    """A view in which marks are shown.

    Attributes:
        pictures: its photos, and its thermal rendering above the scale.
    """

    view: str
    pictures: list[InlineImage]


class ShownProposal(NamedTuple):
    """A proposal as the report shows it; numbers are formatted.

    Attributes:
        mark: as it would be if it were accepted.
        contrast: its temperature minus that of its surroundings.
        low: 10th percentile over the views.
        high: 90th percentile over the views.
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


class Findings(NamedTuple):
    """What was measured and what was found.

    Attributes:
        proposals: anomalies that nobody has judged.
        plan: with all of them; None without any, or where the map shows them all.
        from_the_front: whether the plan is an elevation.
        map: temperatures to scale; None where the scene has no such map.
        map_caption: what the map shows.
    """

    marks: Sequence[ShownMark] = ()
    proposals: Sequence[ShownProposal] = ()
    overviews: Sequence[ShownOverview] = ()
    plan: InlineImage | None = None
    from_the_front: bool = False
    map: InlineImage | None = None
    map_caption: str = ""


def show_findings(
    marks: RunMarks,
    regions: Regions,
    anomalies: Mapping[str, Anomaly],
    scene: Scene,
    survey: Survey,
    t: Texts,
) -> Findings:
    """Measure the marks, and draw them and the anomalies into photos, renderings, plan and map.

    Raises:
        SceneError: a photo cannot be read.
    """
    known = marks.marks
    readings = marks.meter.measure(known, regions)
    proposed = [anomaly.reading for anomaly in anomalies.values()]
    named = {reading.mark.name: reading.mark for reading in (*readings, *proposed)}
    drawn = temperature_map(marks.run, scene, regions)
    found = Findings()
    if drawn is not None:
        picture = inline_image(drawn.picture(named, t.decimal), "map", quality=90)
        found = Findings(map=picture, map_caption=_map_caption(drawn, t))
    if not named:
        return found
    plan = Plan(scene, list(named.values()))

    def place(mark: Mark) -> Image.Image:
        return plan.small(mark) if drawn is None or not drawn.shows(mark) else drawn.small(mark)

    shown, candidates = (
        show_marks(each, reference, regions, scene, survey, place, t.decimal)
        for each, reference in ((readings, known.reference), (proposed, ""))
    )
    all_on_map = drawn is not None and all(map(drawn.shows, named.values()))
    return found._replace(
        marks=shown,
        proposals=[_shown(anomalies[mark.name], mark, marks.run, scene) for mark in candidates],
        overviews=[
            ShownOverview(
                each.view,
                [inline_image(one, ", ".join(each.seen), quality=88) for one in each.pictures],
            )
            for each in overviews(scene, named, regions.render, t.decimal)
        ],
        plan=None if all_on_map else inline_image(plan.whole(named), "plan", png=True),
        from_the_front=plan.from_the_front,
    )


def _map_caption(drawn: TemperatureMap, t: Texts) -> str:
    width, height = drawn.size_m
    what = (
        t("Temperatures of the façade from the front, to scale:")
        if drawn.from_the_front
        else t("Temperatures from above, to scale:")
    )
    rest = t(
        "{width} × {height} m, {pixel} cm per pixel.",
        width=t.number(f"{width:.1f}"),
        height=t.number(f"{height:.1f}"),
        pixel=t.number(pixel_cm_text(drawn.drawn.grid.pixel_m)),
    )
    white = t("White: no surface, or too few photos look there.")
    return f"{what} {rest} {white}"


def _shown(anomaly: Anomaly, mark: ShownMark, run: Run, scene: Scene) -> ShownProposal:
    spot, temperature = anomaly.spot, scene.temperature
    photo = photo_value(scene.views[spot.view], spot)
    return ShownProposal(
        mark,
        value_text(anomaly.contrast, temperature, sign=True),
        _text(spot.low, temperature),
        _text(spot.high, temperature),
        spot.views,
        ", ".join(number_text(each, 2) for each in spot.position.tolist()),
        None if photo is None else _text(photo, temperature),
        photo is not None and not 0 < photo < 1 and run.image_model.thermal_gain is None,
    )


def _text(value: float, temperature: TemperatureRange | None) -> str:
    return value_text(in_unit(THERMAL, value, temperature), temperature)
