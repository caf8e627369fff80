"""``points.ply``: the splats on surfaces as coloured points with temperatures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mrgs.data.ply import write_ply
from mrgs.export.job import ExportJob, described
from mrgs.export.sidecar import comment_lines
from mrgs.export.surface_points import SurfacePoints


def export(job: ExportJob) -> list[Path]:
    """Write ``points.ply`` and its sidecar."""
    path, facts = job.folder / "points.ply", job.surface_facts
    return described(write_points_ply(path, job.points, comment_lines(facts)), facts)


def write_points_ply(path: Path, points: SurfacePoints, comments: Sequence[str] = ()) -> Path:
    """Write x, y, z, red, green, blue, the temperature, other modalities and the opacity; returns
    the path.

    Raises:
        RunError: the file cannot be written.
    """
    columns: dict[str, np.ndarray] = {axis: points.positions[:, i] for i, axis in enumerate("xyz")}
    columns |= {**points.columns, "opacity": points.opacities}
    return write_ply(path, {"vertex": columns}, comments)
