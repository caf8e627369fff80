"""``.splat`` files: 32 bytes per splat, no view dependence, no header."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mrgs.export.job import ExportJob, baking_loss_db, described, loss_facts
from mrgs.export.splats import SplatArrays, to_bytes, without_directions
from mrgs.scene import THERMAL
from mrgs.system.atomic import replacing

_LAYOUT = [("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)]


def export(job: ExportJob) -> list[Path]:
    """Write a file for each modality, with its sidecar."""
    flat = without_directions(job.baked, job.scene.train_cameras)
    lost: dict[str, Any] = {"view_dependence": "left out"}
    if job.run is not None and job.scene.modalities != (THERMAL,):
        # Before the temperatures are corrected: the loss is a comparison with the photos.
        lost["baking_loss_db"] = loss_facts(baking_loss_db(job.run, flat, job.scene))
    paths = []
    corrected = replace(flat, temperatures=job.splat_model.temperatures)
    for modality, splats, facts in job.splats(corrected):
        if modality != THERMAL:
            facts |= lost
        paths += described(write_splat(job.folder / f"{modality}.splat", splats), facts)
    return paths


def write_splat(path: Path, splats: SplatArrays) -> Path:
    """Write the layout that antimatter15's viewer made common; returns the path.

    Centre and standard deviations as float32, RGB of degree 0 and opacity as bytes, the quaternion
    wxyz as bytes about 128. The largest and most opaque splats come first, so that a file shows
    something while it loads."""
    order = np.argsort(-splats.scales.prod(axis=1) * splats.opacities, kind="stable")
    rows = np.empty(len(splats), dtype=_LAYOUT)
    rows["mean"] = splats.means[order]
    rows["scale"] = splats.scales[order]
    rows["color"][:, :3] = splats.base_colors[order]
    rows["color"][:, 3] = to_bytes(splats.opacities[order])
    rows["quat"] = np.rint(splats.quats[order] * 128 + 128).clip(0, 255)
    with replacing(path) as temporary:
        rows.tofile(temporary)
    return path
