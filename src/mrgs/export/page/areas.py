"""Marked surfaces with an emissivity of their own, for the page's script to correct what is seen of
them as ``Regions`` does."""

from __future__ import annotations

import base64
import gzip
from typing import Any

import numpy as np

from mrgs.export.page.packing import GZIP_LEVEL
from mrgs.marks.emissivity import CaptureSettings
from mrgs.marks.regions import REGION_DEPTH, RegionPlane, Regions, SurfaceRegion
from mrgs.pictures.stage import camera_facts
from mrgs.scene import THERMAL

DEPTH_STEP = 1e-3
"""Of the logarithms of depths: an eightieth of what they may differ by."""

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
    camera = camera_facts(region.surface.camera)
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
