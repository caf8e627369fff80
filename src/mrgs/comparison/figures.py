"""The figures of the paper's experiments: photos beside every method, and depth with and without
L_boltz."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mrgs.comparison.panels import Block, Panel, as_drawn, draw_figure
from mrgs.comparison.paper import scene_title
from mrgs.errors import SceneError
from mrgs.evaluation.contact_sheet import SheetRow, sheet_row
from mrgs.evaluation.evaluate import ViewMetrics
from mrgs.evaluation.truth import read_float_tiff
from mrgs.pictures.drawing import Scale
from mrgs.pictures.palette import colorize, display_range, round_up
from mrgs.pictures.values import unit_label
from mrgs.scene import THERMAL, Modality, Rendering, Scene, View

WIDE_PX, NARROW_PX = 300, 220
"""Width of a panel; narrow where there are more than five columns."""

WITHOUT_BOLTZ, WITH_BOLTZ = "mrgs-fourier", "mrgs"


@dataclass(frozen=True, eq=False)
class Exhibit:
    """One view of one scene as every method shows it.

    Attributes:
        scene: as ``load_scene`` returns it.
        folder: the scene's folder, for its exact depths.
        view: the held-out view that is shown.
        shown: the result of ``drawn`` for each method that has images of the view.
        figures: of each method, this view's entry in ``metrics.json``.
    """

    scene: Scene
    folder: Path
    view: View
    shown: Mapping[str, SheetRow]
    figures: Mapping[str, Mapping[str, Any]]

    @property
    def title(self) -> str:
        """Heading: the names of the scene and the view."""
        return f"{scene_title(self.scene.name) or self.scene.name} · {self.view.name}"

    @property
    def unit(self) -> str:
        """Unit of temperatures; empty where the scene has no °C."""
        return "" if self.scene.temperature is None else "°C"


def drawn(scene: Scene, view: View, rendering: Rendering) -> SheetRow:
    """The images of one method in the figures: a view's photos, its renderings, and the depth from
    the thermal camera.

    Args:
        scene: as ``load_scene`` returns it.
        view: one of its held-out views.
        rendering: of the view, with the cameras' response.

    Raises:
        SceneError: a photo cannot be read.
    """
    metrics = ViewMetrics(view.name, {}, None)
    # L_boltz acts on the depth of the thermal camera.
    return sheet_row(view, rendering, metrics, scene.temperature, scene.reach, THERMAL)


def qualitative_figure(blocks: Sequence[Block], methods: Sequence[str]) -> Image.Image:
    """Draw a ``qualitative_block`` per scene, with a column for the ground truth and one per
    method."""
    return draw_figure(["ground truth", *methods], blocks, _cell_px(methods))


def depth_figure(blocks: Sequence[Block]) -> Image.Image:
    """Depth and thermal rendering without and with L_boltz, a ``depth_block`` per scene.

    The exact depth has a column if any scene has it.
    """
    columns = [
        "depth, without L_boltz",
        "thermal, without",
        "depth, with L_boltz",
        "thermal, with",
        "exact depth",
    ]
    if all(panels[-1].image is None for block in blocks for _, panels in block.rows):
        columns.pop()
        blocks = [
            replace(block, rows=[(label, panels[:-1]) for label, panels in block.rows])
            for block in blocks
        ]
    return draw_figure(columns, blocks, WIDE_PX)


def _cell_px(methods: Sequence[str]) -> int:
    return WIDE_PX if len(methods) < 5 else NARROW_PX


def qualitative_block(exhibit: Exhibit, methods: Sequence[str]) -> Block:
    """A row per modality, and one of errors for each with a unit; images have their final size.

    At least one of the methods must be among those that the exhibit shows.
    """
    shown = {method: exhibit.shown.get(method) for method in methods}
    there = [row for row in shown.values() if row is not None]
    photos = there[0]
    rows: list[tuple[str, list[Panel]]] = []
    bars: list[tuple[Scale, str]] = []
    for modality, photo in photos.photos.items():
        captions = [_caption(exhibit, name, modality) for name in shown]
        images = [None if row is None else row.renderings.get(modality) for row in shown.values()]
        if not modality.is_metric:
            panels = [Panel(*pair) for pair in zip(images, captions, strict=True)]
            rows.append((modality.title, [Panel(photo), *panels]))
            continue
        unit = unit_label(modality, exhibit.scene.temperature)
        scale = Scale("inferno", *display_range(photo), unit)
        heat = [
            Panel(_colored(image, scale), caption)
            for image, caption in zip(images, captions, strict=True)
        ]
        rows.append((modality.title, [Panel(_colored(photo, scale)), *heat]))
        bars.append((scale, modality.quantity if unit else "normalised: the scene has no °C"))
        error, error_scale = _error_row(shown, modality, unit)
        rows.append(("error", error))
        signs = (
            "blue too cold, red too warm" if modality == THERMAL else "blue too low, red too high"
        )
        bars.append((error_scale, f"rendering minus photo: {signs}"))
    return as_drawn(Block(exhibit.title, rows, bars), _cell_px(methods))


def _error_row(
    shown: Mapping[str, SheetRow | None], modality: Modality, unit: str
) -> tuple[list[Panel], Scale]:
    """Rendered minus measured values of each method, and the scale of all."""
    errors = [None if row is None else row.errors.get(modality) for row in shown.values()]
    sizes = [np.abs(error).ravel() for error in errors if error is not None]
    limit = round_up(display_range(np.concatenate(sizes), tail=1.0)[1]) if sizes else 1.0
    scale = Scale("error", -limit, limit, unit)
    return [Panel(None, missing=""), *(Panel(_colored(error, scale)) for error in errors)], scale


def depth_block(exhibit: Exhibit) -> Block:
    """Depth and thermal image without and with L_boltz, and the exact depth; images have their
    final size.

    The exhibit must show both ``WITHOUT_BOLTZ`` and ``WITH_BOLTZ``.
    """
    exact = _exact_depth(exhibit)
    pair = {method: exhibit.shown[method] for method in (WITHOUT_BOLTZ, WITH_BOLTZ)}
    depths = [row.depth.ravel() for row in pair.values() if row.depth is not None]
    near, far = display_range(
        exact if exact is not None else np.concatenate(depths or [np.zeros(1)]), tail=1.0
    )
    scale = Scale("depth", far, near, "")
    images = {method: row.renderings.get(THERMAL) for method, row in pair.items()}
    heats = [image.ravel() for image in images.values() if image is not None]
    heat_scale = Scale(
        "inferno", *display_range(np.concatenate(heats or [np.zeros(1)])), exhibit.unit
    )
    panels = []
    for method, row in pair.items():
        panels.append(Panel(_colored(row.depth, scale), _depth_caption(exhibit, method)))
        panels.append(
            Panel(_colored(images[method], heat_scale), _caption(exhibit, method, THERMAL))
        )
    panels.append(Panel(_colored(exact, scale)))
    bars = [(scale, "z-depth in scene units"), (heat_scale, THERMAL.title)]
    return as_drawn(Block(exhibit.title, [("", panels)], bars), WIDE_PX)


def _exact_depth(exhibit: Exhibit) -> np.ndarray | None:
    """None where there is no file, or a damaged one: scoring reports it."""
    path = exhibit.folder / "truth" / "depth" / f"{exhibit.view.name}.tiff"
    if not path.is_file():
        return None
    try:
        depth = read_float_tiff(path)
    except SceneError:
        return None
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan))


def _colored(values: np.ndarray | None, scale: Scale) -> np.ndarray | None:
    return None if values is None else colorize(values, scale.low, scale.high, scale.palette)


def _caption(exhibit: Exhibit, method: str, modality: Modality) -> str:
    """This view's PSNR, and its error in °C where there is one."""
    figures = exhibit.figures.get(method, {}).get(modality.name, {})
    parts = [
        f"{value:.{decimals}f} {unit}"
        for key, decimals, unit in (("psnr", 2, "dB"), ("mae_c", 2, "°C"))
        if (value := figures.get(key)) is not None
    ]
    return " · ".join(parts)


def _depth_caption(exhibit: Exhibit, method: str) -> str:
    value = exhibit.figures.get(method, {}).get("truth", {}).get("depth_median_relative_error")
    return "" if value is None else f"median error {100 * value:.2f} %"
