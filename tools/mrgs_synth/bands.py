"""Further bands of light that a stage can be photographed in; another band is another entry of
``BANDS``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8

from mrgs.scene import Modality
from mrgs_synth.colors import from_srgb, to_srgb
from mrgs_synth.stage import Lamp, Material, Stage

NEAR_INFRARED_LIFT = {"matte": 0.25, "glossy": 0.4, "metal": 0.0}
"""How far dyes and paints are on the way from their strongest colour to white (0 to 1): organic
pigments and clear coats hardly absorb near infrared, metals reflect it as they reflect red."""


@dataclass(frozen=True, eq=False)
class Band:
    """A band of light.

    Attributes:
        modality: of its photos, with one channel.
        reflectance: of a material in this band, from its linear colours [h, w, 3].
    """

    modality: Modality
    reflectance: Callable[[Material, Float[np.ndarray, "h w 3"]], Float[np.ndarray, "h w"]]


def near_infrared(
    material: Material, colors: Float[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w"]:
    """Reflectance at about 850 nm: the strongest colour, lifted towards white."""
    lift = material.infrared_lift
    if lift is None:
        lift = NEAR_INFRARED_LIFT[material.finish]
    strongest = colors.max(axis=2)
    lifted: Float[np.ndarray, "h w"] = strongest + lift * (1.0 - strongest)
    return lifted


BANDS = {"nir": Band(Modality("nir", 1, title="Near infrared"), near_infrared)}
"""By the name of the modality."""


def in_band(stage: Stage, band: Band) -> Stage:
    """A stage whose colours are all grey: its reflectances and its light in one band. Lamps and sky
    have the mean of their colours."""
    return replace(
        stage,
        solids=tuple(
            replace(solid, material=_grey(solid.material, band)) for solid in stage.solids
        ),
        lamps=tuple(_grey_lamp(lamp) for lamp in stage.lamps),
        sky=_grey_sky(stage.sky),
    )


def _grey(material: Material, band: Band) -> Material:
    reflectance = band.reflectance(material, from_srgb(material.texture))
    return replace(material, texture=_repeated(to_srgb(reflectance)))


def _grey_lamp(lamp: Lamp) -> Lamp:
    mean = float(np.mean(lamp.radiance))
    return replace(lamp, radiance=(mean, mean, mean))


def _grey_sky(
    sky: tuple[float, float, float] | Float[np.ndarray, "h w 3"] | None,
) -> tuple[float, float, float] | Float[np.ndarray, "h w 3"] | None:
    if sky is None:
        return None
    if isinstance(sky, tuple):
        mean = float(np.mean(sky))
        return (mean, mean, mean)
    return np.repeat(sky.mean(axis=2, keepdims=True), 3, axis=2)


def _repeated(grey: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    return np.repeat(grey[..., None], 3, axis=2)
