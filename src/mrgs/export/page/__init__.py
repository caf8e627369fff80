"""``page.html``: one HTML file that shows every modality of a model, from a disk, without a
network."""

from __future__ import annotations

from pathlib import Path

from mrgs.export.job import ExportJob
from mrgs.export.page.write import page_marks, write_page
from mrgs.pictures.page_data import air_facts, starting_limits
from mrgs.pictures.settings import settings_of, settings_text
from mrgs.scene import THERMAL
from mrgs.scene.preview import best_view
from mrgs.survey import SURVEY_FILE, read_survey

__all__ = ["export", "write_page"]


def export(job: ExportJob) -> list[Path]:
    """Write ``page.html`` into the job's folder; returns its path."""
    views = [*job.scene.eval, *job.scene.train]
    marks, assumptions = ([], ()) if job.marks is None else page_marks(job.marks)
    path = write_page(
        job.baked,
        {view.name: view.camera for view in views},
        f"{job.scene.name}: thermal model",
        job.folder / "page.html",
        palette=job.palette,
        range_c=_range_c(job),
        notes=(*job.scene.notes, *assumptions),
        marks=marks,
        regions=job.regions,
        modalities=job.modalities,
        length_unit=job.scene.world.length_unit,
        air={} if job.run is None else air_facts(read_survey(job.run.folder.path / SURVEY_FILE)),
        settings=settings_text(settings_of(job.scene.records), "given by the user"),
        start=job.scene.train[best_view(job.scene.train_cameras, job.baked.means)].name,
    )
    return [path]


def _range_c(job: ExportJob) -> tuple[float, float] | None:
    """The ends of the palette: those that the viewer begins with, unless the job has others; None
    where areas are corrected, which photos are not."""
    if job.range_c is not None or job.regions or THERMAL not in job.modalities:
        return job.range_c
    return starting_limits((THERMAL,), job.scene, job.scene.temperature)[THERMAL]
