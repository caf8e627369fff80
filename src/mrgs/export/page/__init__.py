"""``page.html``: one HTML file that shows a model in colour and in °C, from a disk, without a
network."""

from __future__ import annotations

from pathlib import Path

from mrgs.export.job import Job
from mrgs.export.page.write import require_shown, write_page
from mrgs.scene import Scene

__all__ = ["export", "require", "write_page"]


def export(job: Job) -> list[Path]:
    """Write ``page.html``."""
    views = [*job.scene.eval, *job.scene.train]
    path = write_page(
        job.baked,
        {view.name: view.camera for view in views},
        f"{job.scene.name}: thermal model",
        job.folder / "page.html",
        palette=job.palette,
        range_c=job.limits_c,
        notes=job.scene.notes,
        modalities=job.scene.modalities,
    )
    return [path]


def require(scene: Scene) -> None:
    """Check that the scene has something to show.

    Raises:
        ConfigError: it has photos of neither modality that the page shows.
    """
    require_shown(scene.modalities)
