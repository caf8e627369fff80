"""The figures of the paper's experiments: photos beside the renderings of every method, and depth
with and without L_boltz."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mrgs.comparison.tables import scene_title
from mrgs.errors import SceneError
from mrgs.evaluation.contact_sheet import (
    DEPTH_NOTE,
    NORMALISED_NOTE,
    ViewImages,
    colored,
    error_note,
    error_scale,
    pooled,
)
from mrgs.evaluation.evaluate import read_float_tiff
from mrgs.pictures.drawing import Scale
from mrgs.pictures.palette import display_range
from mrgs.pictures.sheet import Bar, Panel, PanelRow, draw_section
from mrgs.pictures.values import unit_label
from mrgs.scene import THERMAL, Modality, Scene, View

WIDE_PX, NARROW_PX = 300, 220
"""Width of a panel; narrow where there are more than five columns."""

LABEL_PX = 88

WITHOUT_BOLTZ, WITH_BOLTZ = "mrgs-fourier", "mrgs"


@dataclass(frozen=True, eq=False)
class Exhibit:
    """One view of one scene as every method shows it.

    Attributes:
        folder: the scene's folder, for its exact depths.
        shown: images by method, with the depth from the thermal camera, on which L_boltz acts.
        figures: by method, this view's entry in ``metrics.json``.
    """

    scene: Scene
    folder: Path
    view: View
    shown: Mapping[str, ViewImages]
    figures: Mapping[str, Mapping[str, Any]]

    @property
    def title(self) -> str:
        """Names of the scene and the view."""
        return f"{scene_title(self.scene.name)} · {self.view.name}"


def qualitative_section(exhibit: Exhibit, methods: Sequence[str]) -> Image.Image:
    """Draw a row per modality, and one of errors for each with a unit; a column for the photo and
    one per method, of which at least one must have images."""
    shown = {method: exhibit.shown.get(method) for method in methods}
    photos = next(images.photos for images in shown.values() if images is not None)
    rows: list[PanelRow] = []
    bars: list[Bar] = []
    for modality, photo in photos.items():
        unit = unit_label(modality, exhibit.scene.temperature)
        scale = Scale("inferno", *display_range(photo), unit) if modality.is_metric else None
        panels = [Panel(colored(photo, scale))]
        for method, images in shown.items():
            rendering = None if images is None else images.renderings.get(modality)
            panels.append(Panel(colored(rendering, scale), _caption(exhibit, method, modality)))
        rows.append(PanelRow(modality.title, panels))
        if scale is None:
            continue
        bars.append(Bar(scale, modality.quantity if unit else NORMALISED_NOTE))
        errors = [None if each is None else each.errors.get(modality) for each in shown.values()]
        scale = error_scale(errors, unit)
        panels = [Panel(None, missing=""), *(Panel(colored(error, scale)) for error in errors)]
        rows.append(PanelRow("error", panels))
        bars.append(Bar(scale, error_note(modality)))
    return draw_section(
        ["ground truth", *methods],
        rows,
        bars,
        cell_px=WIDE_PX if len(methods) < 5 else NARROW_PX,
        label_px=LABEL_PX,
        title=exhibit.title,
    )


def depth_section(exhibit: Exhibit) -> Image.Image:
    """Draw depth and thermal rendering without and with L_boltz, and the exact depth if there is
    one. The exhibit must show both ``WITHOUT_BOLTZ`` and ``WITH_BOLTZ``."""
    exact, path = None, exhibit.folder / "truth" / "depth" / f"{exhibit.view.name}.tiff"
    if path.is_file():
        with suppress(SceneError):  # a damaged file, which scoring reports
            found = read_float_tiff(path)
            exact = np.where(np.isfinite(found) & (found > 0), found, np.float32(np.nan))
    pair = {method: exhibit.shown[method] for method in (WITHOUT_BOLTZ, WITH_BOLTZ)}
    depths = pooled([images.depth for images in pair.values()])
    near, far = display_range(depths if exact is None else exact, tail=1.0)
    depth_scale = Scale("depth", far, near, "")
    heats = {method: images.renderings.get(THERMAL) for method, images in pair.items()}
    unit = unit_label(THERMAL, exhibit.scene.temperature)
    heat_scale = Scale("inferno", *display_range(pooled([*heats.values()])), unit)
    panels = []
    for method, images in pair.items():
        truth = exhibit.figures.get(method, {}).get("truth", {})
        error = truth.get("depth_median_relative_error")
        text = "" if error is None else f"median error {100 * error:.2f} %"
        panels.append(Panel(colored(images.depth, depth_scale), text))
        heat = colored(heats[method], heat_scale)
        panels.append(Panel(heat, _caption(exhibit, method, THERMAL)))
    columns = ["depth without L_boltz", "thermal without", "depth with L_boltz", "thermal with"]
    if exact is not None:
        columns.append("exact depth")
        panels.append(Panel(colored(exact, depth_scale)))
    bars = [Bar(depth_scale, DEPTH_NOTE), Bar(heat_scale, THERMAL.title)]
    return draw_section(
        columns, [PanelRow("", panels)], bars, cell_px=WIDE_PX, label_px=0, title=exhibit.title
    )


def _caption(exhibit: Exhibit, method: str, modality: Modality) -> str:
    """This view's PSNR, and its error in °C where there is one."""
    figures = exhibit.figures.get(method, {}).get(modality.name, {})
    parts = [
        f"{value:.2f} {unit}"
        for key, unit in (("psnr", "dB"), ("mae_c", "°C"))
        if (value := figures.get(key)) is not None
    ]
    return " · ".join(parts)
