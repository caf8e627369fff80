"""The input of all writers: the baked model, its scene, the facts about both for sidecars, and what
an export costs in quality."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float32, Float64

from mrgs.evaluation.metrics import psnr
from mrgs.export.splats import (
    SplatArrays,
    shaded_splats,
    temperature_name,
    thermal_splats,
    value_names,
)
from mrgs.export.surface_points import Columns, SurfacePoints, surface_points
from mrgs.maps.crs import place_facts
from mrgs.maps.options import MapOptions
from mrgs.marks.measure import MarkReading
from mrgs.marks.photo_readings import PhotoReadings
from mrgs.marks.regions import Regions
from mrgs.marks.run_marks import RunMarks, thermal_cameras
from mrgs.marks.uncertainty import UncertaintyMeter
from mrgs.pictures.drawing import Scale
from mrgs.pictures.files import to_array
from mrgs.pictures.palette import PaletteName
from mrgs.pictures.values import unit_of
from mrgs.rasterizer.contract import DILATION_PX2, LEAST_DILATION_PX2, Dilation
from mrgs.runs.baked import BakedModel
from mrgs.runs.open import Run
from mrgs.scene import BUILT_IN, THERMAL, Camera, Modality, Scene, evenly_spaced, ideal_cameras
from mrgs.survey import Survey
from mrgs.system.atomic import write_text

BakingLoss: TypeAlias = dict[Modality, float | None]
"""Mean over the held-out views of PSNR(photo, trained model) − PSNR(photo, baked model) of each
modality, dB; None without photos.

Negative where the baked model is closer to the photos.
"""

NOTED_VIEWS, NOTED_PX = 16, 320
"""Number and width of the views by which ``correction_note`` judges."""


@dataclass(frozen=True, eq=False)
class ExportJob:
    """What one export writes, and where.

    Attributes:
        baked: the exported model, as the photos have it, with the modalities of which there are
            some.
        up: the up direction of the scene's frame, unit length, [3]; None if not known.
        facts: for the sidecar of every file, see ``facts_of``; ``surface_facts`` and
            ``splat_facts`` also say how marked surfaces are corrected.
        marks: of the run that was baked; None if only the baked model is available.
        regions: marked surfaces with an emissivity of their own; None without.
        loss: PSNR lost by baking, dB; None without a run.
        survey: of the run, empty without one.
        range_c: °C of the palette's first and last colour, as the caller gave them.
    """

    baked: BakedModel
    scene: Scene
    folder: Path
    scale: Scale
    up: Float64[np.ndarray, "3"] | None
    facts: dict[str, Any]
    marks: RunMarks | None
    regions: Regions | None
    loss: BakingLoss | None
    survey: Survey
    palette: PaletteName
    range_c: tuple[float, float] | None
    maps: MapOptions

    @property
    def run(self) -> Run | None:
        """The run that was baked; None if only the baked model is available."""
        return None if self.marks is None else self.marks.run

    @property
    def modalities(self) -> tuple[Modality, ...]:
        """The modalities to write, RGB first."""
        return self.baked.modalities

    @cached_property
    def readings(self) -> list[MarkReading]:
        """The run's marks, measured once; none without a run."""
        return [] if self.marks is None else self.marks.measure()

    @cached_property
    def points(self) -> SurfacePoints:
        """The splats on surfaces as points with their uncertainty, computed once."""
        points = surface_points(self.baked, self.scene)
        if THERMAL not in self.modalities:
            return points
        name = temperature_name(self.baked)
        corrected, around = self.appraised(points.positions, points.columns[name])
        columns = {**points.columns, name: corrected}
        if self.uncertainty is not None:
            columns[name.replace("temperature", "uncertainty")] = around
        return replace(points, columns=columns)

    def corrected(self, positions: Float32[np.ndarray, "m 3"], columns: Columns) -> Columns:
        """Columns of a file for points of the model, as cameras see them, with the temperatures of
        marked surfaces corrected."""
        if self.regions is None:
            return columns
        name = temperature_name(self.baked)
        return {**columns, name: self.regions.corrected_at(positions, columns[name])}

    def appraised(
        self, positions: Float32[np.ndarray, "m 3"], celsius: Float32[np.ndarray, " m"]
    ) -> tuple[Float32[np.ndarray, " m"], Float32[np.ndarray, " m"]]:
        """Temperatures at points of the model, corrected on marked surfaces, and their uncertainty;
        see ``Appraise``."""
        around = np.full_like(celsius, np.nan)
        if self.uncertainty is not None:
            around = self.uncertainty.of_points(positions, celsius, self.regions)
        if self.regions is not None:
            celsius = self.regions.corrected_at(positions, celsius)
        return celsius, around

    @cached_property
    def uncertainty(self) -> UncertaintyMeter | None:
        """Uncertainty of the temperatures; None without thermal photos."""
        if THERMAL not in self.scene.modalities:
            return None
        if self.marks is not None:
            return self.marks.meter.uncertainty
        baked, scene, known = self.baked, self.scene, self.baked.temperature
        views = scene.survey_views(THERMAL)
        readings = PhotoReadings(baked.render, ideal_cameras, views, known)
        return UncertaintyMeter.of(readings, scene, known, Survey())

    @property
    def surface_facts(self) -> dict[str, Any]:
        """``facts`` for files with the temperatures of surfaces, not of single splats."""
        if "temperature" not in self.facts:
            return self.facts
        of_surface = {"of": "the surface, as the cameras see it"}
        if self.regions is not None:
            own = "marked surfaces that have one are corrected, as their marks are"
            of_surface |= {"own_emissivity": own}
        return self.facts | {"temperature": self.facts["temperature"] | of_surface}

    @cached_property
    def splat_model(self) -> BakedModel:
        """The model for files of splats: on marked surfaces their temperatures are corrected."""
        return self.baked if self.regions is None else self.regions.of_splats(self.baked)

    @cached_property
    def splat_facts(self) -> dict[str, Any]:
        """``facts`` for files of ``splat_model``."""
        if self.regions is None:
            return self.facts
        cameras = thermal_cameras(self.scene)
        note = correction_note(self.baked, self.splat_model, self.regions, cameras)
        return self.facts | {"temperature": self.facts["temperature"] | {"own_emissivity": note}}

    def splats(self) -> Iterator[tuple[Modality, SplatArrays, dict[str, Any]]]:
        """Yield each modality to write, its splats from ``splat_model``, and their file's facts."""
        baked = self.splat_model
        for modality in self.modalities:
            facts = self.splat_facts | color_facts(modality, self.scale, baked)
            is_thermal, scale = modality == THERMAL, self.scale
            splats = thermal_splats(baked, scale) if is_thermal else shaded_splats(baked, modality)
            yield modality, splats, facts


def described(path: Path, facts: Mapping[str, Any]) -> list[Path]:
    """Write the facts about a file beside it, as ``NAME.SUFFIX.json``; returns the paths of both.
    RunError if the file cannot be written."""
    content = json.dumps({"file": path.name, **facts}, indent=1, ensure_ascii=False)
    return [path, write_text(path.with_name(f"{path.name}.json"), content)]


def facts_of(
    baked: BakedModel,
    scene: Scene,
    up: Float64[np.ndarray, "3"] | None,
    loss: BakingLoss | None,
    crs: str | None = None,
) -> dict[str, Any]:
    """Facts about every file of an export: program, frame, units, temperatures, and the PSNR lost
    by baking, None if the trained model was not available; the CRS is the user's wish, see
    ``coordinate_system``."""
    return {
        "program": f"mrgs {version('mrgs')}",
        "scene": scene.name,
        "splats": len(baked),
        "frame": "the scene's own world frame, right-handed, as in its camera file",
        "length_unit": "metre"
        if scene.world.metric
        else "scene unit (a metre if the scene's camera poses are in metres)",
        **place_facts(scene, crs),
        "up": None if up is None else [round(float(x), 6) for x in up],
        "up_from": "the cameras, taken to be level" if up is not None else "not known",
        "camera_axes": "OpenCV: x right, y down, z forward",
        **_temperature_facts(baked),
        **_other_facts(baked),
        "opacities": f"for a viewer that adds {_in_words(baked.dilation)} to the projected "
        f"covariance and nothing else; 3DGS and most viewers add {DILATION_PX2:g} px²",
        "dilation": asdict(baked.dilation),
        "baking_loss_db": None if loss is None else loss_facts(loss),
        "baking": "the view-dependent colour residual is folded into spherical harmonics of "
        "degree 3; what depends on the view in the temperatures is left out; baking_loss_db is the "
        "mean PSNR over the held-out views that this costs (null: not measured)",
    }


def _in_words(dilation: Dilation) -> str:
    same = f"{dilation.px2:g} px²"
    if dilation.finest_focal_px is None:
        return same
    finest = f"{dilation.finest_focal_px:.0f}"
    return (
        f"{same} ({same} · (f / {finest})² where its focal length f is below {finest} px, and at "
        f"least {LEAST_DILATION_PX2:g} px²)"
    )


def loss_facts(loss: BakingLoss) -> dict[str, float | None]:
    """A baking loss in dB by the names of the modalities, for JSON."""
    return {modality.name: value for modality, value in loss.items()}


def color_facts(modality: Modality, scale: Scale, baked: BakedModel) -> dict[str, Any]:
    """The meaning of the colours in a file of one modality: palette, values of its first and last
    colour, unit.

    Empty for a modality of three channels, whose colours are its own.
    """
    if modality.channels == 3:
        return {}
    if modality != THERMAL:
        scale = Scale("grey", 0.0, 1.0, unit_of(modality, baked.temperature))
    shown = {"palette": scale.palette, "first": scale.low, "last": scale.high, "unit": scale.unit}
    return {"colors": shown}


def comment_lines(facts: Mapping[str, Any]) -> list[str]:
    """Facts as lines ``name: value`` for a file's header."""
    return [
        f"{name}: {value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)}"
        for name, value in facts.items()
    ]


def _temperature_facts(baked: BakedModel) -> dict[str, Any]:
    """Property, unit and range of the temperatures; empty for a model without them."""
    if THERMAL not in baked.modalities:
        return {}
    facts: dict[str, Any] = {
        "property": temperature_name(baked),
        "of": "each splat, before blending: a surface shows the blend of many",
    }
    known = baked.temperature
    if known is None:
        facts |= {"unit": "normalised: no °C is known for this scene", "min": 0.0, "max": 1.0}
    else:
        facts |= {"unit": "°C", "min": known.min_c, "max": known.max_c}
    return {"temperature": facts}


def _other_facts(baked: BakedModel) -> dict[str, Any]:
    """Properties and unit of each modality beyond colours and temperatures, by its name."""
    return {
        modality.name: {
            "property": ", ".join(value_names(baked, modality)),
            "unit": unit_of(modality, baked.temperature),
            "min": 0.0,
            "max": 1.0,
        }
        for modality in baked.modalities
        if modality not in BUILT_IN
    }


def baking_loss_db(run: Run, baked: BakedModel, scene: Scene) -> BakingLoss:
    """PSNR of each modality that baking costs, averaged over the held-out views, dB; None for a
    modality without photos. SceneError if a photo cannot be read."""
    losses: dict[Modality, list[float]] = {modality: [] for modality in baked.modalities}
    for view in scene.eval:
        cameras = {each: camera for each, camera in view.cameras.items() if each in losses}
        if not cameras:
            continue
        trained, plain = (
            run.camera_response(model.render(cameras), view.camera) for model in (run, baked)
        )
        for modality in cameras:
            photo = view.images[modality].load()
            of_trained, of_plain = (
                psnr(each[modality].image, photo.values, photo.valid) for each in (trained, plain)
            )
            losses[modality].append(of_trained - of_plain)
    means: BakingLoss = {}
    for modality, each in losses.items():
        # That of identical images, or of images without a valid pixel, is not finite.
        finite = [loss for loss in each if math.isfinite(loss)]
        means[modality] = round(math.fsum(finite) / len(finite), 4) + 0.0 if finite else None
    return means


def correction_note(
    uncorrected: BakedModel, corrected: BakedModel, regions: Regions, cameras: Sequence[Camera]
) -> str:
    """A sentence on how far the blend of splats that were corrected one by one is from the
    correction of the uncorrected blend, in the pixels of the regions in some of the views."""
    note = (
        "Marked surfaces with an emissivity of their own are corrected splat by splat, which is "
        "not exact there and right beside them"
    )
    assert uncorrected.temperature is not None
    span_c, found = uncorrected.temperature.span_c, []
    for index in evenly_spaced(len(cameras), NOTED_VIEWS):
        camera = cameras[index].at_most(NOTED_PX)
        plain = uncorrected.render({THERMAL: camera})
        exact = regions.applied_to(plain, camera)[THERMAL].image
        blended = corrected.render({THERMAL: camera})[THERMAL].image
        own = exact != plain[THERMAL].image
        found.append(to_array(span_c * (blended - exact)[own].abs()))
    errors = np.concatenate(found)
    if not len(errors):
        return f"{note}."
    half, most = np.percentile(errors, [50, 95])
    return f"{note}: half of their pixels are off by up to {half:.1f} °C, 95 % by up to {most:.1f}."
