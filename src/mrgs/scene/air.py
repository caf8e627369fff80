"""The air between camera and object: what it lets through, and what it adds."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import astuple
from statistics import median
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.scene.radiometry import BandRadiance, ObjectParameters, PhotoRecord
from mrgs.scene.rendering import SOLID_ALPHA, Blend
from mrgs.system.typed_json import Finite


class Atmosphere(NamedTuple):
    """Constants of air's transmission, as in FLIR's files; ``x`` weighs the two exponentials."""

    alpha1: float
    alpha2: float
    beta1: float
    beta2: float
    x: float

    def decays(self, air_c: float, humidity: float) -> tuple[float, float]:
        """The exponentials' α + β √ω, with the water in the air
        ω = humidity · exp(1.5587 + 0.06939 t − 2.7816e-4 t² + 6.8455e-7 t³)."""
        powers = 1.5587 + 0.06939 * air_c - 2.7816e-4 * air_c**2 + 6.8455e-7 * air_c**3
        root = math.sqrt(humidity * math.exp(powers))
        return self.alpha1 + self.beta1 * root, self.alpha2 + self.beta2 * root

    def transmission(self, distance_m: float, air_c: float, humidity: float) -> float:
        """The share of the object's radiation that reaches the camera."""
        distance = torch.tensor(distance_m, dtype=torch.float64)
        return float(_transmission(distance, *self.decays(air_c, humidity), self.x))


USUAL_AIR = Atmosphere(0.006569, 0.01262, -0.002276, -0.00667, 1.9)
"""The constants that FLIR's cameras store."""


LEAST_TRANSMISSION = 0.01
"""The empirical formula falls below 0 in kilometres of damp air."""

DELIVERED_C = 20.0
"""Temperature of air and reflection for which cameras are set when they are delivered, °C."""


def usual_parameters(records: Iterable[PhotoRecord]) -> ObjectParameters | None:
    """The medians of the photos' parameters; None if none are known."""
    known = [astuple(each.parameters) for each in records if each.parameters is not None]
    return ObjectParameters(*map(median, zip(*known, strict=True))) if known else None


class AirPath(NamedTuple):
    """What air does to photos whose temperatures were computed for one distance d, while every
    pixel has its own distance D. Such a photo shows R' = r R + (1 − r) A with r = τ(D) / τ(d), R
    the radiance of what it would show from d (``BandRadiance``), and A = (R(T_air) − (1 − ε)
    R(T_refl)) / ε; this solves the measurement formula, τ (ε R + (1 − ε) R(T_refl)) + (1 − τ)
    R(T_air), for what the camera computes. Not in the paper, whose radiation with depth it is.

    Attributes:
        decay1, decay2: of τ(D) = x exp(−decay1 √D) + (1 − x) exp(−decay2 √D), 1 / √m.
        noted, added: τ(d) and A.
        farthest: distance, m, beyond which there is only background, the sky for instance, of which
            a photo says what reaches the camera through all of the air.
    """

    decay1: Finite
    decay2: Finite
    x: Finite
    noted: Finite
    added: Finite
    farthest: Finite

    @classmethod
    def of(
        cls,
        records: Iterable[PhotoRecord],
        radiance: BandRadiance | None,
        farthest: float = math.inf,
    ) -> AirPath | None:
        """The air of a scene's photos; None where their parameters are not known, or the air is as
        the camera was delivered: what a path of tens of metres of it would add is not known."""
        records = list(records)
        noted = usual_parameters(records)
        if noted is None or radiance is None or not _is_set(noted, records):
            return None
        share, decays = noted.emissivity, USUAL_AIR.decays(noted.atmospheric_c, noted.humidity)
        air, reflected = map(radiance.of_celsius, (noted.atmospheric_c, noted.reflected_c))
        tau = USUAL_AIR.transmission(noted.distance_m, noted.atmospheric_c, noted.humidity)
        if tau < LEAST_TRANSMISSION:
            return None
        added = (air - (1 - share) * reflected) / share
        return cls(*decays, USUAL_AIR.x, tau, added, farthest)

    def received(self, radiance: Float[Tensor, "h w 1"], blend: Blend) -> Float[Tensor, "h w 1"]:
        """R' of R and the blend's z-depth, in metres; R where the blend shows no surface or only
        background. No gradient moves the depth."""
        depth = (blend.depth / blend.alpha).detach()
        is_solid = (blend.alpha >= SOLID_ALPHA) & (depth <= self.farthest)
        tau = _transmission(depth.clamp_min(0), self.decay1, self.decay2, self.x)
        share = torch.where(is_solid, tau.clamp_min(LEAST_TRANSMISSION) / self.noted, 1.0)
        share = share[:, :, None]
        return share * radiance + (1 - share) * self.added


def _is_set(noted: ObjectParameters, records: Iterable[PhotoRecord]) -> bool:
    """Whether somebody has set the air, in the camera or for the program."""
    delivered = noted.atmospheric_c, noted.reflected_c
    is_as_delivered = all(abs(celsius - DELIVERED_C) < 0.05 for celsius in delivered)
    return not is_as_delivered or any("atmospheric_c" in each.given for each in records)


def _transmission(distance: Tensor, decay1: float, decay2: float, x: float) -> Tensor:
    root = distance.sqrt()
    return x * torch.exp(-decay1 * root) + (1 - x) * torch.exp(-decay2 * root)
