"""Writes the model, the cameras and the viewer's code into one HTML file."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mrgs.errors import ConfigError
from mrgs.export.page.packing import PackedModel, pack
from mrgs.export.page.visibility import most_visible
from mrgs.pictures.files import shown_values
from mrgs.pictures.html import asset, script_json, write_html
from mrgs.pictures.palette import PaletteName, display_range, palette_table
from mrgs.pictures.values import in_unit, range_of, unit_label
from mrgs.runs.baked import BakedModel
from mrgs.scene import (
    THERMAL,
    Camera,
    Modality,
    evenly_spaced,
    in_order,
    metric_first,
)
from mrgs.scene.camera_paths import focus_point

SCRIPTS = ("decode.js", "shaders.js", "renderer.js", "navigation.js", "app.js")
ASSETS: dict[str, Any] = {
    "styles": ["export/page/page.css"],
    "scripts": [f"export/page/{name}" for name in SCRIPTS],
    "sources": ["worker-src blob:"],
}
"""Style sheet, scripts and their policy, see ``write_html``."""

PALETTES: tuple[PaletteName, ...] = ("inferno", "iron", "grey", "rainbow")

RANGE_VIEWS = 8
RANGE_WIDTH_PX = 160
SURFACE_ALPHA = 0.5
"""Below this accumulated alpha the page shows no surface, and reads no temperature."""


def write_page(
    baked: BakedModel,
    cameras: Mapping[str, Camera],
    title: str,
    path: Path,
    *,
    palette: PaletteName = "inferno",
    range_c: tuple[float, float] | None = None,
    max_splats: int | None = None,
    sh_degree: int = 3,
    notes: Sequence[str] = (),
    modalities: Sequence[Modality] | None = None,
) -> Path:
    """Write the model as one HTML page; returns its path.

    The page needs WebGL2 and nothing from the network, which its Content-Security-Policy forbids.
    It takes about 7 MB for 100,000 splats with RGB and thermal (4 MB with ``sh_degree=1``).

    Args:
        baked: N splats.
        cameras: of the captured views, by name; the page opens on the first.
        title: heading of the page.
        path: ends with .html.
        palette: inferno, iron, grey or rainbow; the reader may choose another.
        range_c: temperatures at the ends of the palette, °C (normalised without °C); None takes
            those of what some of the cameras see.
        max_splats: keep only this many, those that paint most of the photos.
        sh_degree: 0 to 3; a lower degree makes a smaller file with less view dependence.
        notes: sentences for the section on temperatures.
        modalities: to show; None shows all of the model's.

    Raises:
        ConfigError: there are no cameras, splats or modalities, or an option is out of its range.
        RunError: the file cannot be written.
    """
    shown = in_order(baked.modalities if modalities is None else modalities)
    _check(shown, cameras, palette, range_c, max_splats, sh_degree)
    every = list(cameras.values())
    baked = _reduced(baked, every, max_splats)
    packed = pack(baked, sh_degree, shown)
    facts = _facts(baked, packed, every, shown, range_c)
    return write_html(
        path,
        "export/page/page.html",
        title=title,
        **ASSETS,
        modalities=facts["modalities"],
        has_thermal=THERMAL in shown,
        date=date.today().isoformat(),
        temperature=baked.temperature,
        palettes=PALETTES,
        palette=palette,
        cameras=list(cameras),
        notes=notes,
        splats=packed.header["count"],
        left_out=len(baked) - packed.header["count"],
        facts=script_json(facts),
        worker=asset("export/page/worker.js"),
        model=_base64(packed.data),
    )


def _reduced(baked: BakedModel, cameras: Sequence[Camera], max_splats: int | None) -> BakedModel:
    """The splats that paint most of the photos; all without a limit."""
    if max_splats is None:
        return baked
    return baked.subset(most_visible(baked, cameras, max_splats))


def visible_range(
    baked: BakedModel, modality: Modality, cameras: Sequence[Camera]
) -> tuple[float, float]:
    """Limits of a one-channel modality that hold all but half a percent, at each end, of what some
    of the cameras see; in its unit."""
    seen = []
    for index in evenly_spaced(len(cameras), RANGE_VIEWS):
        small = cameras[index].with_width(RANGE_WIDTH_PX)
        blend = baked.render({modality: small})[modality]
        values = shown_values(modality, blend.image, None)
        seen.append(values[blend.alpha.numpy() >= SURFACE_ALPHA])
    low, high = display_range(np.concatenate(seen))
    return (
        in_unit(modality, low, baked.temperature),
        in_unit(modality, high, baked.temperature),
    )


def _check(
    modalities: Sequence[Modality],
    cameras: Mapping[str, Camera],
    palette: PaletteName,
    range_c: tuple[float, float] | None,
    max_splats: int | None,
    sh_degree: int,
) -> None:
    if not modalities:
        raise ConfigError("the page needs at least one modality to show")
    if not cameras:
        raise ConfigError("the page needs at least one camera to open on")
    if palette not in PALETTES:
        raise ConfigError(f"the page has no palette {palette}; choose one of {', '.join(PALETTES)}")
    if range_c is not None and not -np.inf < range_c[0] < range_c[1] < np.inf:
        raise ConfigError(
            f"the temperature range {range_c[0]:g} to {range_c[1]:g} must rise from a number to a "
            f"larger one"
        )
    if max_splats is not None and max_splats < 1:
        raise ConfigError(f"max_splats is {max_splats}; it must be at least 1")
    if sh_degree not in range(4):
        raise ConfigError(f"sh_degree is {sh_degree}; it must be from 0 to 3")


def _camera(camera: Camera) -> dict[str, Any]:
    return {
        "rotation": camera.viewmat[:3, :3].flatten().tolist(),
        "position": camera.position.tolist(),
        "fx": camera.K[0, 0].item(),
        "fy": camera.K[1, 1].item(),
        "cx": camera.K[0, 2].item(),
        "cy": camera.K[1, 2].item(),
        "width": camera.width,
        "height": camera.height,
    }


def _world(cameras: Sequence[Camera]) -> dict[str, list[float]]:
    """Where the cameras look, and which way is up: against their mean down axis."""
    up = -torch.stack([camera.viewmat[1, :3] for camera in cameras]).mean(dim=0)
    if up.norm() < 1e-6:
        up = -cameras[0].viewmat[1, :3]
    return {"focus": focus_point(cameras).tolist(), "up": (up / up.norm()).tolist()}


def _facts(
    baked: BakedModel,
    packed: PackedModel,
    cameras: Sequence[Camera],
    shown: Sequence[Modality],
    range_c: tuple[float, float] | None,
) -> dict[str, Any]:
    """What the page's script reads as JSON."""
    return {
        "model": packed.header,
        "cameras": [_camera(camera) for camera in cameras],
        "world": _world(cameras),
        "palettes": {name: _base64(palette_table(name).tobytes()) for name in PALETTES},
        "modalities": [_modality_facts(each, baked, cameras, range_c) for each in shown],
        "readable": [each.name for each in metric_first(shown) if each.channels == 1],
    }


def _modality_facts(
    modality: Modality,
    baked: BakedModel,
    cameras: Sequence[Camera],
    range_c: tuple[float, float] | None,
) -> dict[str, Any]:
    """What the page's script knows of a modality: its name and label, whether a palette shows it,
    what the normalised values 0 and 1 stand for, and the ends of the palette."""
    low, high = range_of(modality, baked.temperature)
    ends = low, high
    if modality == THERMAL and range_c is not None:
        ends = range_c
    elif modality.is_metric:
        ends = visible_range(baked, modality, cameras)
    quantity = modality.quantity
    return {
        "name": modality.name,
        "label": quantity[:1].upper() + quantity[1:],
        "channels": modality.channels,
        "metric": modality.is_metric,
        "scale": {"min": low, "max": high, "unit": unit_label(modality, baked.temperature)},
        "range": list(ends),
    }


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")
