"""Writes the model, the cameras and the viewer's code into one HTML file."""

from __future__ import annotations

import base64
from collections.abc import Collection, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mrgs.errors import ConfigError
from mrgs.export.page.packing import pack
from mrgs.export.page.visibility import most_visible
from mrgs.pictures.files import to_array
from mrgs.pictures.html import asset, script_json, write_html
from mrgs.pictures.palette import PaletteName, display_range, palette_table
from mrgs.runs.baked import BakedModel
from mrgs.scene import RGB, THERMAL, Camera, Modality, TemperatureRange, spread
from mrgs.scene.camera_paths import focus_point

SCRIPTS = ("decode.js", "shaders.js", "renderer.js", "navigation.js", "app.js")
PALETTES: tuple[PaletteName, ...] = ("inferno", "iron", "grey", "rainbow")

SHOWN = (RGB, THERMAL)
"""The modalities that the page can show."""

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
    modalities: Sequence[Modality] = SHOWN,
) -> Path:
    """Write the model as one self-contained HTML page; returns its path.

    The page needs WebGL2 and nothing from the network: no script, font, image or style of another
    place, which its Content-Security-Policy also forbids. It takes about 7 MB for 100,000 splats (4
    MB with ``sh_degree=1``).

    Args:
        baked: N splats.
        cameras: of the captured views, by name; the page opens on the first.
        title: heading of the page.
        path: ends with .html.
        palette: inferno, iron, grey or rainbow; the reader may choose another.
        range_c: ends of the palette in °C (normalised values where the scene has no °C); by default
            those of what some of the cameras see.
        max_splats: keep only so many, those that paint most of the photos.
        sh_degree: 0 to 3; fewer degrees make a smaller file, whose colours depend less on the view.
        notes: sentences to add to what the page says about its temperatures.
        modalities: those of which the scene has photos; the page shows those of them that are in
            ``SHOWN``.

    Raises:
        ConfigError: there are no cameras or no splats, or an option is out of its range.
        RunError: the file cannot be written.
    """
    _check(modalities, cameras, palette, range_c, max_splats, sh_degree)
    shown = list(cameras.values())
    if max_splats is not None:
        baked = baked.subset(most_visible(baked, shown, max_splats))
    packed = pack(baked, sh_degree)
    kinds = [modality.name for modality in SHOWN if modality in modalities]
    facts = {
        "model": packed.header,
        "cameras": [_camera(camera) for camera in shown],
        "world": _world(shown),
        "palettes": {name: _base64(palette_table(name).tobytes()) for name in PALETTES},
        "modalities": kinds,
        "range": list(range_c if range_c is not None else visible_range(baked, shown)),
        "temperature": _scale(baked.temperature),
    }
    return write_html(
        path,
        "export/page/page.html",
        title=title,
        styles=["export/page/page.css"],
        scripts=[f"export/page/{name}" for name in SCRIPTS],
        sources=["worker-src blob:"],
        modalities=" ".join(kinds),
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


def visible_range(baked: BakedModel, cameras: Sequence[Camera]) -> tuple[float, float]:
    """Limits that hold all but half a percent, at each end, of what some of the cameras see; °C
    where known."""
    seen = []
    for index in spread(len(cameras), RANGE_VIEWS):
        small = cameras[index].with_width(RANGE_WIDTH_PX)
        thermal = baked.render({THERMAL: small})[THERMAL]
        seen.append(to_array(thermal.image[..., 0][thermal.alpha >= SURFACE_ALPHA]))
    low, high = display_range(np.concatenate(seen))
    if baked.temperature is None:
        return low, high
    return baked.temperature.to_celsius(low), baked.temperature.to_celsius(high)


def require_shown(modalities: Collection[Modality]) -> None:
    """Check that the page can show one of the modalities.

    Raises:
        ConfigError: it cannot.
    """
    if not set(modalities) & set(SHOWN):
        raise ConfigError(f"the page needs {' or '.join(map(str, SHOWN))} to show")


def _check(
    modalities: Sequence[Modality],
    cameras: Mapping[str, Camera],
    palette: PaletteName,
    range_c: tuple[float, float] | None,
    max_splats: int | None,
    sh_degree: int,
) -> None:
    require_shown(modalities)
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


def _scale(temperature: TemperatureRange | None) -> dict[str, Any]:
    if temperature is None:
        return {"min": 0.0, "max": 1.0, "unit": ""}
    return {"min": temperature.min_c, "max": temperature.max_c, "unit": "°C"}


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")
