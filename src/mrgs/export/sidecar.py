"""The meaning of the numbers in an exported file: header comments and a JSON sidecar."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from mrgs.export.loss import BakingLoss
from mrgs.export.splats import temperature_name, value_names
from mrgs.maps.crs import place_facts
from mrgs.pictures.drawing import Scale
from mrgs.pictures.values import unit_of
from mrgs.rasterizer.contract import DILATION_PX2, LEAST_DILATION_PX2, Dilation
from mrgs.runs.baked import BakedModel
from mrgs.scene import BUILT_IN, THERMAL, Modality, Scene
from mrgs.system.atomic import write_text


def facts_of(
    baked: BakedModel,
    scene: Scene,
    up: Float64[np.ndarray, "3"] | None,
    loss: BakingLoss | None,
    crs: str | None = None,
) -> dict[str, Any]:
    """Facts about every file of an export: program, frame, units, temperatures, and the PSNR lost
    by baking, None if the trained model was not available; the CRS is the user's wish, see
    ``coordinate_system``."""
    return {
        "program": f"mrgs {version('mrgs')}",
        "scene": scene.name,
        "splats": len(baked),
        "frame": "the scene's own world frame, right-handed, as in its camera file",
        "length_unit": "metre"
        if scene.world.metric
        else "scene unit (a metre if the scene's camera poses are in metres)",
        **place_facts(scene, crs),
        "up": None if up is None else [round(float(x), 6) for x in up],
        "up_from": "the cameras, taken to be level" if up is not None else "not known",
        "camera_axes": "OpenCV: x right, y down, z forward",
        **_temperature_facts(baked),
        **_other_facts(baked),
        "opacities": f"for a viewer that adds {_in_words(baked.dilation)} to the projected "
        f"covariance and nothing else; 3DGS and most viewers add {DILATION_PX2:g} px²",
        "dilation": asdict(baked.dilation),
        "baking_loss_db": None if loss is None else loss_facts(loss),
        "baking": "the view-dependent colour residual is folded into spherical harmonics of "
        "degree 3; what depends on "
        "the view in the temperatures is left out; baking_loss_db is the mean PSNR over the "
        "held-out views that this "
        "costs (null: not measured)",
    }


def _in_words(dilation: Dilation) -> str:
    same = f"{dilation.px2:g} px²"
    if dilation.finest_focal_px is None:
        return same
    finest = f"{dilation.finest_focal_px:.0f}"
    return (
        f"{same} ({same} · (f / {finest})² where its focal length f is below {finest} px, and at "
        f"least {LEAST_DILATION_PX2:g} px²)"
    )


def loss_facts(loss: BakingLoss) -> dict[str, float | None]:
    """A baking loss in dB by the names of the modalities, for JSON."""
    return {modality.name: value for modality, value in loss.items()}


def color_facts(modality: Modality, scale: Scale, baked: BakedModel) -> dict[str, Any]:
    """The meaning of the colours in a file of one modality: palette, values of its first and last
    colour, unit.

    Empty for a modality of three channels, whose colours are its own.
    """
    if modality.channels == 3:
        return {}
    if modality != THERMAL:
        scale = Scale("grey", 0.0, 1.0, unit_of(modality, baked.temperature))
    shown = {"palette": scale.palette, "first": scale.low, "last": scale.high, "unit": scale.unit}
    return {"colors": shown}


def comment_lines(facts: Mapping[str, Any]) -> list[str]:
    """Facts as lines ``name: value`` for a file's header."""
    return [
        f"{name}: {value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)}"
        for name, value in facts.items()
    ]


def write_sidecar(path: Path, facts: Mapping[str, Any]) -> Path:
    """Write the facts about a file beside it, as ``NAME.SUFFIX.json``; returns that path. RunError
    if the file cannot be written."""
    content = json.dumps({"file": path.name, **facts}, indent=1, ensure_ascii=False)
    return write_text(path.with_name(f"{path.name}.json"), content)


def _temperature_facts(baked: BakedModel) -> dict[str, Any]:
    """Property, unit and range of the temperatures; empty for a model without them."""
    if THERMAL not in baked.modalities:
        return {}
    facts: dict[str, Any] = {
        "property": temperature_name(baked),
        "of": "each splat, before blending: a surface shows the blend of many",
    }
    known = baked.temperature
    if known is None:
        facts |= {"unit": "normalised: no °C is known for this scene", "min": 0.0, "max": 1.0}
    else:
        facts |= {"unit": "°C", "min": known.min_c, "max": known.max_c}
    return {"temperature": facts}


def _other_facts(baked: BakedModel) -> dict[str, Any]:
    """Properties and unit of each modality beyond colours and temperatures, by its name."""
    return {
        modality.name: {
            "property": ", ".join(value_names(baked, modality)),
            "unit": unit_of(modality, baked.temperature),
            "min": 0.0,
            "max": 1.0,
        }
        for modality in baked.modalities
        if modality not in BUILT_IN
    }
