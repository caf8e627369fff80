"""The figures of the paper's experiments: photos beside every method, and depth with and without L_boltz."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mrgs.comparison.panels import Block, Panel, draw_figure
from mrgs.comparison.paper import scene_title
from mrgs.evaluation.contact_sheet import SheetRow, sheet_row
from mrgs.evaluation.drawing import Scale
from mrgs.evaluation.evaluate import ViewMetrics
from mrgs.evaluation.palette import colorize, display_range, round_up
from mrgs.evaluation.truth import read_float_tiff
from mrgs.render import Rendering
from mrgs.scene import Scene, View

WIDE_PX, NARROW_PX = 300, 220
"""Width of a panel; narrow where there are more than five columns."""

WITHOUT_BOLTZ, WITH_BOLTZ = "mrgs-fourier", "mrgs"

Renderer = Callable[[View], Rendering]


@dataclass(frozen=True, eq=False)
class Exhibit:
    """One view of one scene as every method shows it.

    Attributes:
        scene: what ``load_scene`` returns.
        folder: the scene's folder, for its exact depths.
        view: the held-out view that is shown.
        renderers: of each method, from the view to its images, as they are compared with the photos.
        figures: of each method, this view's entry in ``metrics.json``.
    """

    scene: Scene
    folder: Path
    view: View
    renderers: Mapping[str, Renderer]
    figures: Mapping[str, Mapping[str, Any]]

    @property
    def title(self) -> str:
        """The scene and the view."""
        return f"{scene_title(self.scene.name) or self.scene.name} · {self.view.name}"

    def shown(self, method: str) -> SheetRow | None:
        """The photos and the method's renderings, its depth from the thermal camera; None where it has none."""
        if method not in self.renderers:
            return None
        rendering = self.renderers[method](self.view)
        if rendering.depth_thermal is not None:  # what L_boltz acts on
            rendering = rendering._replace(depth_rgb=None)
        nothing = ViewMetrics(self.view.name, {}, {}, None)
        return sheet_row(self.view, rendering, nothing, self.scene.temperature, self.scene.reach)


def qualitative_figure(exhibits: Sequence[Exhibit], methods: Sequence[str]) -> Image.Image:
    """Rows RGB, thermal and thermal error of each scene; columns ground truth and methods."""
    columns = ["ground truth", *methods]
    blocks = [_qualitative_block(exhibit, methods) for exhibit in exhibits]
    return draw_figure(columns, blocks, WIDE_PX if len(columns) <= 5 else NARROW_PX)


def depth_figure(exhibits: Sequence[Exhibit]) -> Image.Image:
    """Depth and thermal rendering without and with L_boltz, a row per scene; the exact depth where a scene has it."""
    exact = [_exact_depth(exhibit) for exhibit in exhibits]
    columns = ["depth, without L_boltz", "thermal, without", "depth, with L_boltz", "thermal, with"]
    columns += ["exact depth"] if any(depth is not None for depth in exact) else []
    blocks = [_depth_block(exhibit, depth, len(columns)) for exhibit, depth in zip(exhibits, exact, strict=True)]
    return draw_figure(columns, blocks, WIDE_PX)


def _qualitative_block(exhibit: Exhibit, methods: Sequence[str]) -> Block:
    shown = {method: exhibit.shown(method) for method in methods}
    there = [row for row in shown.values() if row is not None]
    photos = there[0]
    unit = "" if exhibit.scene.temperature is None else "°C"
    rows: list[tuple[str, list[Panel]]] = []
    bars = []
    if photos.photo is not None:
        panels = [
            Panel(None if row is None else row.rgb, _caption(exhibit, name, "rgb")) for name, row in shown.items()
        ]
        rows.append(("RGB", [Panel(photos.photo), *panels]))
    if photos.measured is not None:
        scale = Scale("inferno", *display_range(photos.measured), unit)
        errors = [np.abs(row.error).ravel() for row in there if row.error is not None]
        limit = round_up(display_range(np.concatenate(errors), tail=1.0)[1]) if errors else 1.0
        error_scale = Scale("error", -limit, limit, unit)
        heat = [
            Panel(_colored(None if row is None else row.thermal, scale), _caption(exhibit, name, "thermal"))
            for name, row in shown.items()
        ]
        error = [Panel(_colored(None if row is None else row.error, error_scale)) for row in shown.values()]
        rows.append(("thermal", [Panel(_colored(photos.measured, scale)), *heat]))
        rows.append(("error", [Panel(None, missing=""), *error]))
        bars = [(scale, "temperature" if unit else "normalised: the scene has no °C")]
        bars.append((error_scale, "rendering minus photo: blue too cold, red too warm"))
    return Block(exhibit.title, rows, bars)


def _depth_block(exhibit: Exhibit, exact: np.ndarray | None, columns: int) -> Block:
    pair = [exhibit.shown(method) for method in (WITHOUT_BOLTZ, WITH_BOLTZ)]
    depths = [row.depth.ravel() for row in pair if row is not None and row.depth is not None]
    near, far = display_range(exact if exact is not None else np.concatenate(depths or [np.zeros(1)]), tail=1.0)
    scale = Scale("depth", far, near, "")
    heats = [row.thermal.ravel() for row in pair if row is not None and row.thermal is not None]
    heat_scale = Scale(
        "inferno", *display_range(np.concatenate(heats or [np.zeros(1)])), "°C" if exhibit.scene.temperature else ""
    )
    panels = []
    for method, row in zip((WITHOUT_BOLTZ, WITH_BOLTZ), pair, strict=True):
        panels.append(Panel(_colored(None if row is None else row.depth, scale), _depth_caption(exhibit, method)))
        heat = _colored(None if row is None else row.thermal, heat_scale)
        panels.append(Panel(heat, _caption(exhibit, method, "thermal")))
    panels += [Panel(_colored(exact, scale))] * (columns - len(panels))
    return Block(exhibit.title, [("", panels)], [(scale, "z-depth in scene units"), (heat_scale, "thermal")])


def _exact_depth(exhibit: Exhibit) -> np.ndarray | None:
    path = exhibit.folder / "truth" / "depth" / f"{exhibit.view.name}.tiff"
    if not path.is_file():
        return None
    depth = read_float_tiff(path)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan))


def _colored(values: np.ndarray | None, scale: Scale) -> np.ndarray | None:
    return None if values is None else colorize(values, scale.low, scale.high, scale.palette)


def _caption(exhibit: Exhibit, method: str, group: str) -> str:
    """This view's PSNR, and its error in °C where there is one."""
    figures = exhibit.figures.get(method, {}).get(group, {})
    parts = [
        f"{value:.{decimals}f} {unit}"
        for key, decimals, unit in (("psnr", 2, "dB"), ("mae_c", 2, "°C"))
        if (value := figures.get(key)) is not None
    ]
    return " · ".join(parts)


def _depth_caption(exhibit: Exhibit, method: str) -> str:
    value = exhibit.figures.get(method, {}).get("truth", {}).get("depth_median_relative_error")
    return "" if value is None else f"median error {100 * value:.2f} %"
