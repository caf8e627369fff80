"""A trained run, or its baked model, into a folder of files for other programs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

from mrgs.errors import ConfigError, MrgsError, RunError, WriteError, warn_user
from mrgs.export.formats import FORMATS, Format
from mrgs.export.job import BakingLoss, ExportJob, baking_loss_db, facts_of
from mrgs.export.splats import require_exportable, thermal_scale
from mrgs.maps.crs import coordinate_system
from mrgs.maps.options import MapOptions
from mrgs.maps.surfaces import up_direction
from mrgs.marks import open_marks
from mrgs.pictures.palette import PaletteName
from mrgs.runs.baked import BakedModel, bake
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Scene
from mrgs.survey import SURVEY_FILE, Survey, read_survey

Progress: TypeAlias = Callable[[int, int, str], None]
"""Called with the number of the part that begins, the number of parts, and the part's name."""

DEFAULT_MAPS = MapOptions()

BAKING = "baking"
"""The part of an export before its formats: the model as plain splats."""


def export_run(
    run: Run,
    folder: str | Path | None = None,
    format: str = "all",
    palette: PaletteName | None = None,
    range_c: tuple[float, float] | None = None,
    maps: MapOptions = DEFAULT_MAPS,
    progress: Progress | None = None,
) -> list[Path]:
    """Write a run in one format, or in all that can be written here, for other programs; returns
    the paths.

    Args:
        run: what ``load_run`` or ``train`` returns.
        folder: made if it does not exist; files of these names are replaced. The run's folder
            ``export`` if None.
        format: the name of one of ``mrgs.export.FORMATS``, or ``all``.
        palette: colours of the colour-mapped files; None takes that of the run's survey, else
            inferno.
        range_c: °C of the palette's first and last colour; None takes the scene's whole range
            for splats, a map's own for a map; the page then begins with the viewer's range, or
            with what the model shows to the photos' cameras where areas are corrected.
        maps: choices for ``ortho`` and ``elevation``.
        progress: called when a part begins, as by ``mrgs.progress_bar``.

    Raises:
        ConfigError: an unknown format, a range that cannot be used, an extra that is not installed,
            or a map that the scene does not allow.
        RunError: the model cannot be exported, or a file cannot be written.
        SceneError: the scene or a photo cannot be read.
    """
    target = run.folder.path / "export" if folder is None else Path(folder)
    scene = run.load_scene()
    return export(run, scene, format, target, palette, range_c, maps, progress=progress)


def export(
    model: Run | BakedModel,
    scene: Scene,
    format: str | Sequence[str],
    folder: Path,
    palette: PaletteName | None = None,
    range_c: tuple[float, float] | None = None,
    maps: MapOptions = DEFAULT_MAPS,
    on_baked: Callable[[BakingLoss], None] | None = None,
    progress: Progress | None = None,
) -> list[Path]:
    """Write a model in one format, or in all, into a folder; returns the paths. For palette, range,
    maps and errors see ``export_run``.

    Formats of ``all`` that cannot be written are left out, with a warning that says why.

    Splat formats write one file for each modality that the scene has photos of: ``rgb.ply``,
    ``thermal.ply`` in the colours of the palette, any other in grey under its own name.

    Beside each file but those of ``cameras`` and ``page``, ``NAME.SUFFIX.json`` lists units,
    axes, temperature range and baking loss.

    Args:
        model: a run, which is baked here, or a model that is baked already (its baking loss is then
            not measured).
        format: the name of one of ``FORMATS``, several names, or ``all``.
        on_baked: called with the PSNR that baking a run costs, dB.
        progress: called before each part with its number, the number of parts, and its name: first
            ``BAKING``, then each format.
    """
    if maps.crs is not None:  # said now, not after minutes of baking and rendering
        coordinate_system(scene, maps.crs)
    if format == "all":
        chosen = []
        for each in FORMATS.values():
            if each.in_all:
                try:
                    each.require(scene, maps.crs)
                    chosen.append(each)
                except ConfigError as error:
                    _note_left_out(each, error)
    else:
        names = [format] if isinstance(format, str) else format
        if unknown := [name for name in names if name not in FORMATS]:
            raise ConfigError(
                f"unknown export format {unknown[0]!r}: choose one of {', '.join(FORMATS)}, or all"
            )
        chosen = [FORMATS[name] for name in names]
        for each in chosen:
            each.require(scene, maps.crs)
    parts = [BAKING, *(each.name for each in chosen)]
    report = progress or (lambda number, count, name: None)
    report(1, len(parts), BAKING)
    job = _job(model, scene, folder, palette, range_c, maps)
    if job.loss is not None and on_baked is not None:
        on_baked(job.loss)
    paths = []
    for number, each in enumerate(chosen, start=2):
        report(number, len(parts), each.name)
        try:
            paths += each.export(job)
        except WriteError:  # the next would fail as well
            raise
        except MrgsError as error:
            if format == each.name:
                raise
            _note_left_out(each, error)
    return paths


def _note_left_out(format: Format, error: MrgsError) -> None:
    warn_user(f"{format.name} is left out: {error}")


def _job(
    model: Run | BakedModel,
    scene: Scene,
    folder: Path,
    palette: PaletteName | None,
    range_c: tuple[float, float] | None,
    maps: MapOptions,
) -> ExportJob:
    run = None
    if isinstance(model, Run):
        run, model = model, bake(model.model, scene.train_cameras, model.temperature, model.device)
    baked = model.only(scene.modalities)  # others still are as they began
    if not baked.modalities:
        has = ", ".join(modality.title for modality in scene.modalities)
        raise RunError(
            f"the model renders nothing that scene {scene.name} has photos of ({has}): give the "
            f"scene that it was trained on"
        )
    require_exportable(baked)
    survey = Survey() if run is None else read_survey(run.folder.path / SURVEY_FILE)
    palette = palette or survey.palette or "inferno"
    scale, up = thermal_scale(baked, palette, range_c), up_direction(scene)
    loss = None if run is None else baking_loss_db(run, baked, scene)
    facts = facts_of(baked, scene, up, loss, maps.crs)
    if run is not None and run.crop is not None:
        facts["crop"] = {**run.crop._asdict(), "splats_left_out": run.left_out}
    marks = None if run is None else open_marks(run, scene)
    regions = None
    if marks is not None and scene.train_photos(THERMAL):
        regions = marks.meter.regions(marks.marks) or None
    return ExportJob(
        baked, scene, folder, scale, up, facts, marks, regions, loss, survey, palette, range_c, maps
    )
