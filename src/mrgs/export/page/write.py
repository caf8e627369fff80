"""``page.html``: one HTML file that shows every modality of a model, from a disk, without a
network: model, cameras, marks, marked areas and the viewer's code."""

from __future__ import annotations

import base64
import gzip
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from markupsafe import Markup
from PIL import Image

from mrgs.errors import ConfigError
from mrgs.export.job import ExportJob
from mrgs.export.page.packing import GZIP_LEVEL, PART, PageModel
from mrgs.export.splats import require_ascending
from mrgs.marks.emissivity import CaptureSettings
from mrgs.marks.regions import REGION_DEPTH, RegionPlane, Regions, SurfaceRegion
from mrgs.marks.run_marks import RunMarks, thermal_cameras
from mrgs.marks.tables import corrected_text, label_text, mark_text
from mrgs.pictures import page_data
from mrgs.pictures.files import shown_values, to_picture
from mrgs.pictures.html import InlineImage, asset, inline_image, script_json, write_html
from mrgs.pictures.page_data import PALETTE_CHOICES, air_facts
from mrgs.pictures.palette import PaletteName, display_range
from mrgs.pictures.settings import settings_of, settings_text
from mrgs.pictures.values import in_unit, range_of
from mrgs.runs.baked import BakedModel
from mrgs.scene import THERMAL, Camera, Modality, Scene, evenly_spaced, in_order, metric_first
from mrgs.scene.preview import best_view

DEPTH_STEP = 1e-3
"""Quantisation step of the logarithms of depths: an eightieth of what they may differ by."""

NO_PLANE = RegionPlane(np.zeros(3), 0.0)


def area_facts(regions: Regions) -> dict[str, Any] | None:
    """What ``areas.js`` reads: the camera's law, by the names of ``Planck``, and each region; None
    where the model shows none of them."""
    law = regions.capture.law
    areas = [
        _facts(region, regions.capture)
        for region in regions
        if (region.inside & np.isfinite(region.surface.depth)).any()
    ]
    if not areas:
        return None
    return {
        "modality": THERMAL.name,
        "near": REGION_DEPTH,
        "law": {"amplitude": law.r1 / law.r2, "b": law.b, "f": law.f},
        "areas": areas,
    }


def _facts(region: SurfaceRegion, capture: CaptureSettings) -> dict[str, Any]:
    """A region that some pixels of its surface lie in: its depths, in the rectangle about them,
    as steps of their logarithm from the nearest, which is 1; 0 where they are not the region's."""
    depth = np.where(region.inside, region.surface.depth, np.nan)
    rows, columns = np.nonzero(np.isfinite(depth))
    patch = depth[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    nearest = float(np.nanmin(patch))
    codes = np.nan_to_num(1 + np.rint(np.log(patch / nearest) / DEPTH_STEP)).clip(0, 65535)
    camera = page_data.camera_facts(region.surface.camera)
    camera |= {"cx": camera["cx"] - int(columns.min()), "cy": camera["cy"] - int(rows.min())}
    gain, offset = capture.signal_change(region.settings)
    plane = region.plane or NO_PLANE
    return {
        "camera": camera | {"width": patch.shape[1], "height": patch.shape[0]},
        "plane": {"normal": plane.normal.tolist(), "offset": plane.offset},
        "gain": gain,
        "offset": offset,
        "nearest": nearest,
        "step": DEPTH_STEP,
        "depths": base64.b64encode(
            gzip.compress(codes.astype("<u2").tobytes(), GZIP_LEVEL, mtime=0)
        ).decode("ascii"),
    }


PageMark: TypeAlias = dict[str, Any]
"""``mark_text``, with the places of the mark and its label in the picture."""


def page_marks(marks: RunMarks) -> tuple[list[PageMark], tuple[str, ...]]:
    """The marks of a run, and what was assumed for their uncertainties and for surfaces with an
    emissivity of their own. RunError if ``marks.json`` is of another model."""
    known, temperature = marks.marks, marks.run.temperature
    if not len(known):
        return [], ()
    shown = []
    for reading in marks.meter.measure(known):
        mark, text = reading.mark, mark_text(reading, known.reference, temperature, marks.world)
        # An area's own settings are in no field here.
        corrected = [corrected_text(reading)] if mark.has_settings and not reading.problem else []
        shown.append(
            {
                **text,
                "lines": [*text["lines"], *corrected],
                "points": [[round(each, 6) for each in point] for point in mark.points],
                "closed": mark.is_area,
                "lowAt": list(reading.low_at) or None,
                "highAt": list(reading.high_at) or None,
                "label": label_text(reading, temperature),
            }
        )
    of_uncertainty = () if marks.meter.uncertainty is None else marks.meter.uncertainty.notes
    has_own = any(mark.has_settings for mark in known.marks)
    return shown, (*of_uncertainty, *(marks.meter.capture.notes if has_own else ()))


DRAWING = ("dilation", "radiance", "areas", "shaders", "surface", "renderer", "stream")
OWN_SCRIPTS = (*DRAWING, "spots", "saving", "app")
WORKER_SCRIPTS = [
    page_data.BASE64_SCRIPT,
    page_data.GEOMETRY_SCRIPT,
    *(f"export/page/{name}.js" for name in ("dilation", "radiance", "decode", "worker")),
]
ASSETS: dict[str, Any] = {
    "styles": [page_data.STAGE_STYLE, page_data.MARKS_STYLE, "export/page/page.css"],
    "scripts": [*page_data.STAGE_SCRIPTS, *(f"export/page/{name}.js" for name in OWN_SCRIPTS)],
    "sources": ["worker-src blob:"],
}
"""Style sheet, scripts and their policy, see ``write_html``."""

PALETTE: PaletteName = "inferno"
MOST_PHOTOS, PHOTO_PX = 120, 640
RANGE_VIEWS = 8
RANGE_WIDTH_PX = 160
SURFACE_ALPHA = 0.5
"""Below this accumulated alpha the page shows no surface, and reads no temperature."""


@dataclass(frozen=True)
class PageContent:
    """What the page shows beside the model, and how it begins.

    Attributes:
        palette: one of ``PALETTE_CHOICES``; the reader may choose another.
        range_c: temperatures at the ends of the palette, °C (normalised without °C); None takes
            those of what some of the cameras see.
        notes: sentences for the section on temperatures.
        modalities: to show; None shows all of the model's. The page opens on the first of them that
            has a unit.
        start: name of the view that the page opens at; None takes the first.
        marks, air, settings, photos: see ``page_marks``, ``air_facts``, ``settings_text`` and
            ``view_photos``.
        regions: surfaces with an emissivity of their own, whose temperatures the page corrects.
        thermal_cameras: of the photos; spots are three pixels of the nearest wide, as marks are.
            Without any they are a pixel of the picture.
        part_size: splats of a part, see ``PageModel``.
    """

    palette: PaletteName = PALETTE
    range_c: tuple[float, float] | None = None
    notes: Sequence[str] = ()
    modalities: Sequence[Modality] | None = None
    start: str | None = None
    marks: Sequence[PageMark] = ()
    regions: Regions | None = None
    thermal_cameras: Sequence[Camera] = ()
    length_unit: str = "scene units"
    air: Mapping[str, float | None] = field(default_factory=dict)
    settings: str = ""
    photos: Mapping[str, InlineImage] = field(default_factory=dict)
    part_size: int = PART


def export(job: ExportJob) -> list[Path]:
    """Write ``page.html`` into the job's folder; returns its path."""
    scene = job.scene
    marks, assumptions = ([], ()) if job.marks is None else page_marks(job.marks)
    survey = job.survey
    range_c = job.range_c or (survey.scale if scene.temperature is not None else None)
    if range_c is None and not job.regions and THERMAL in job.modalities:
        range_c = page_data.starting_limits((THERMAL,), scene, scene.temperature)[THERMAL]
    content = PageContent(
        job.palette,
        range_c,
        (*scene.notes, *assumptions),
        job.modalities,
        scene.train[best_view(scene.train_cameras, job.baked.means)].name,
        marks,
        job.regions,
        thermal_cameras(scene),
        scene.world.length_unit,
        air_facts(survey) if job.run else {},
        settings_text(settings_of(scene.records), "given by the user"),
        {} if survey.photos_in_page is False else view_photos(scene, job.palette),
    )
    cameras = {view.name: view.camera for view in (*scene.eval, *scene.train)}
    title = f"{scene.name}: thermal model"
    return [write_page(job.baked, cameras, title, job.folder / "page.html", content)]


def view_photos(scene: Scene, palette: PaletteName = PALETTE) -> dict[str, InlineImage]:
    """Small photos of at most ``MOST_PHOTOS`` views by their names; the thermal one, in the
    palette, where there is no other. SceneError if one cannot be read."""
    views, temperature, found = scene.views, scene.temperature, {}
    for view in (views[index] for index in evenly_spaced(len(views), MOST_PHOTOS)):
        modality, photo = next((each, view.images[each]) for each in in_order(view.images))
        values = photo.look(PHOTO_PX).values
        picture = Image.fromarray(to_picture(modality, values, temperature, palette))
        picture.thumbnail((PHOTO_PX, PHOTO_PX))
        found[view.name] = inline_image(picture, view.name, quality=72)
    return found


def write_page(
    baked: BakedModel,
    cameras: Mapping[str, Camera],
    title: str,
    path: Path,
    content: PageContent | None = None,
) -> Path:
    """Write the model with the cameras of its views, by name, as one HTML page; returns its path.

    The page needs WebGL2 and nothing from the network, which its Content-Security-Policy forbids.
    It takes about 7 MB for 100,000 splats with RGB and thermal. A model of more than
    ``content.part_size`` splats is shown coarsely first, and finely as its parts are read.
    ConfigError if there are no cameras, splats or modalities, or an option is out of its range;
    RunError if the file cannot be written."""
    content = content or PageContent()
    modalities = baked.modalities if content.modalities is None else content.modalities
    shown = metric_first(in_order(modalities))
    _check(shown, cameras, content)
    every, start = list(cameras.values()), content.start or next(iter(cameras))
    model = PageModel(baked, shown, cameras[start], content.part_size)
    regions = content.regions
    areas = area_facts(regions) if regions and THERMAL in shown else None
    facts = {
        "model": model.facts,
        "cameras": [page_data.camera_facts(camera) for camera in every],
        "photos": [page_data.camera_facts(camera) for camera in content.thermal_cameras],
        "world": page_data.world_facts(every),
        "palettes": page_data.palette_facts(PALETTE_CHOICES),
        "modalities": [_modality_facts(each, baked, every, content) for each in shown],
        "readable": [each.name for each in shown if each.channels == 1],
        "areas": areas,
        "marks": list(content.marks),
        "length_unit": content.length_unit,
        "air": content.air,
    }
    return write_html(
        path,
        "export/page/page.html",
        title=title,
        **ASSETS,
        modalities=facts["modalities"],
        has_thermal=THERMAL in shown,
        has_areas=areas is not None,
        date=date.today().isoformat(),
        temperature=baked.temperature,
        palettes=PALETTE_CHOICES,
        cameras=list(cameras),
        start=start,
        splats=model.count,
        left_out=len(baked) - model.count,
        content=content,
        facts=script_json(facts),
        worker=Markup("\n").join(map(asset, WORKER_SCRIPTS)),
        parts=(Markup(part.to_json()) for part in model.parts()),
    )


def visible_range(
    baked: BakedModel, modality: Modality, cameras: Sequence[Camera], regions: Regions | None = None
) -> tuple[float, float]:
    """Limits of a one-channel modality: percentiles 0.5 and 99.5 of what some of the cameras see,
    in its unit, with the temperatures of regions corrected."""
    seen = []
    for index in evenly_spaced(len(cameras), RANGE_VIEWS):
        small = cameras[index].at_most(RANGE_WIDTH_PX)
        rendering = baked.render({modality: small})
        if regions is not None:
            rendering = regions.applied_to(rendering, small)
        blend = rendering[modality]
        values = shown_values(modality, blend.image, None)
        seen.append(values[blend.alpha.numpy() >= SURFACE_ALPHA])
    low, high = display_range(np.concatenate(seen))
    return in_unit(modality, low, baked.temperature), in_unit(modality, high, baked.temperature)


def _check(
    modalities: Sequence[Modality], cameras: Mapping[str, Camera], content: PageContent
) -> None:
    if not modalities:
        raise ConfigError("the page needs at least one modality to show")
    if not cameras:
        raise ConfigError("the page needs at least one camera to open on")
    if content.palette not in PALETTE_CHOICES:
        raise ConfigError(
            f"the page has no palette {content.palette}; choose one of {', '.join(PALETTE_CHOICES)}"
        )
    if content.range_c is not None:
        require_ascending(*content.range_c)


def _modality_facts(
    modality: Modality, baked: BakedModel, cameras: Sequence[Camera], content: PageContent
) -> Mapping[str, Any]:
    """A modality for the page's script, with the ends of its palette."""
    if modality == THERMAL and content.range_c is not None:
        ends = content.range_c
    elif modality.is_metric:
        ends = visible_range(baked, modality, cameras, content.regions)
    else:
        ends = range_of(modality, baked.temperature)
    return page_data.modality_facts(modality, baked.temperature, ends)
