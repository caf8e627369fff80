"""How exact splats are whose temperatures were corrected for an emissivity one by one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from mrgs.marks.regions import Regions
from mrgs.pictures.files import to_array
from mrgs.runs.baked import BakedModel
from mrgs.scene import THERMAL, Camera, evenly_spaced

VIEWS = 16
WIDTH_PX = 320


def correction_note(
    uncorrected: BakedModel, corrected: BakedModel, regions: Regions, cameras: Sequence[Camera]
) -> str:
    """How far the blend of corrected splats is from the correction of the blend, in the pixels of
    the regions in some of the views, as a sentence.

    Args:
        uncorrected: the splats as the photos have them.
        corrected: the same, see ``Regions.of_splats``.
        regions: surfaces with an emissivity of their own.
        cameras: of the thermal photos.
    """
    note = (
        "Marked surfaces with an emissivity of their own are corrected splat by splat, which is "
        "not exact there and right beside them"
    )
    errors = np.concatenate(
        [
            _errors_c(uncorrected, corrected, regions, cameras[index])
            for index in evenly_spaced(len(cameras), VIEWS)
        ]
    )
    if not len(errors):
        return f"{note}."
    half, most = np.percentile(errors, [50, 95])
    return f"{note}: half of their pixels are off by up to {half:.1f} °C, 95 % by up to {most:.1f}."


def _errors_c(
    uncorrected: BakedModel, corrected: BakedModel, regions: Regions, camera: Camera
) -> Float32[np.ndarray, " n"]:
    """Of the pixels of the regions in a view, K."""
    assert uncorrected.temperature is not None
    if camera.width > WIDTH_PX:
        camera = camera.with_width(WIDTH_PX)
    plain = uncorrected.render({THERMAL: camera})
    exact = regions.applied_to(plain, camera)[THERMAL].image
    blended = corrected.render({THERMAL: camera})[THERMAL].image
    own = exact != plain[THERMAL].image
    return to_array(uncorrected.temperature.span_c * (blended - exact)[own].abs())
