"""The photos that one camera takes on one walk: when, how far it has drifted, what it writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from mrgs.scene.radiometry import PhotoRecord
from mrgs_synth.imager import Detector, ThermalImager

BEGUN = datetime(2026, 1, 15, 9, 0)
"""The camera's clock at second 0 of every series."""


@dataclass(frozen=True)
class Moment:
    """A photo of a series: its number and second, the drift of its thermal image in °C, and how
    many stops more light its photo gets than the average one."""

    number: int
    second: float
    drift_c: float
    exposure_ev: float


@dataclass(frozen=True, eq=False)
class Series:
    """A series of photos.

    Attributes:
        camera: its name.
        imager: the camera.
        focus_m: distance in focus; 0 for infinity.
        moments: by the photos' names, in the order of time.
        seed: of the detector and its noise.
    """

    camera: str
    imager: ThermalImager
    focus_m: float
    moments: Mapping[str, Moment]
    seed: int

    @classmethod
    def of(
        cls, camera: str, imager: ThermalImager, focus_m: float, names: Sequence[str], seed: int
    ) -> Series:
        """The series of photos with these names, in the order of time."""
        rng = np.random.default_rng([seed, 5])
        seconds, drifts_c = imager.drift.series(len(names), rng)
        exposures_ev = rng.normal(0.0, imager.exposure_ev, len(names))
        values = np.stack([seconds, drifts_c, exposures_ev], axis=1).tolist()
        moments = {name: Moment(n, *values[n]) for n, name in enumerate(names)}
        return cls(camera, imager, focus_m, moments, seed)

    def detector(self, size: tuple[int, int], reference_c: float) -> Detector:
        """The camera's detector."""
        rng = np.random.default_rng([self.seed, 6])
        return Detector.of(self.imager, size, reference_c, rng)

    def thermal_photo(
        self,
        name: str,
        detector: Detector,
        radiance: Float[np.ndarray, "h w"],
        beside: UInt8[np.ndarray, "h2 w2 3"],
    ) -> Float[np.ndarray, "h2 w2"]:
        """The thermal image of this name, °C, from the radiance on the detector's pixels and the
        photo beside it."""
        moment = self.moments[name]
        rng = np.random.default_rng([self.seed, 7, moment.number])
        return detector.photo(radiance, moment.drift_c, beside, rng)

    def records(self) -> dict[str, PhotoRecord]:
        """What the camera notes beside each photo."""
        return {
            name: PhotoRecord(
                source="generated", camera=self.camera, has_numbers=True,
                taken=BEGUN + timedelta(seconds=round(moment.second)),
            )
            for name, moment in self.moments.items()
        }  # fmt: skip

    def parameters(self, detector: Detector) -> dict[str, Any]:
        """What the camera did, for ``truth/camera/camera.json``."""
        left = {"hot": detector.hot, "dead": detector.dead}
        return {
            "camera": self.camera,
            **asdict(self.imager),
            "focus_m": self.focus_m or None,
            "reference_c": detector.reference_c,
            "replaced_pixels": int(detector.replaced.sum()),
            **{f"{kind}_pixels": np.argwhere(where).tolist() for kind, where in left.items()},
            "photos": {name: asdict(moment) for name, moment in self.moments.items()},
        }
