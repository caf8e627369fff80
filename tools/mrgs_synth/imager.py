"""Thermal cameras as they are sold, for judging: nothing here follows the method's image model.

A pixel averages band radiance (``planck``), the lens blurs by diffraction and by a defocus that
depends on depth (``optics``), the whole picture drifts (``drift``), and what the maker's program
does to the pixels comes last.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import gaussian_filter, zoom

from mrgs.errors import ConfigError
from mrgs_synth.colors import luminance
from mrgs_synth.drift import Drift
from mrgs_synth.optics import through_lens
from mrgs_synth.planck import band_radiance, radiance_per_degree, temperature
from mrgs_synth.radiometry import block_means

WAVELENGTH_UM = 10.0
"""Of the diffraction: the middle of the band."""

SHARPENING_PX = 1.0
"""Standard deviation of the unsharp mask, in pixels of the detector."""

EDGE_PX = 1.5
"""Standard deviation of the blur that a photo loses to become edges, in pixels of the image."""

HOT_PIXEL_C = 15.0


@dataclass(frozen=True)
class ThermalImager:
    """A thermal camera, with the photo camera beside it. By default it is perfect, but for
    diffraction.

    °C of what the electronics add apply to surfaces at the reference temperature, the scene's
    median: it is radiance that they add, which is more °C where a surface is colder.

    Attributes:
        enlargement: pixels of the written image per detector pixel and side.
        pitch_um: between the detector's pixels; each collects over this whole square.
        f_number: of the lens.
        aperture_mm: diameter of its opening, on which the defocus depends.
        focus_m: distance in focus; None for what the middle of the first photo shows.
        netd_c: standard deviation of the noise of a detector pixel, new in each photo.
        pattern_c: standard deviation of the detector pixels' offsets, the same in all photos.
        column_c: standard deviation of the columns' offsets, the same in all photos.
        shading_c: how much less corners read than the centre, on average, in all photos.
        drift: of whole photos.
        defective: share of the detector's pixels that are dead or hot.
        missed: share of these that the camera does not replace by their neighbours' mean.
        sharpening: weight of the unsharp mask.
        edges_c: what an edge between black and white in the photo adds to the thermal image.
        exposure_ev: standard deviation of the photos' exposures, in stops.
    """

    enlargement: int = 1
    pitch_um: float = 17.0
    f_number: float = 1.0
    aperture_mm: float = 0.0
    focus_m: float | None = None
    netd_c: float = 0.0
    pattern_c: float = 0.0
    column_c: float = 0.0
    shading_c: float = 0.0
    drift: Drift = field(default_factory=Drift)
    defective: float = 0.0
    missed: float = 0.0
    sharpening: float = 0.0
    edges_c: float = 0.0
    exposure_ev: float = 0.0

    @property
    def cutoff(self) -> float:
        """Finest detail that the lens resolves, cycles per detector pixel."""
        return self.pitch_um / (WAVELENGTH_UM * self.f_number)

    def exposed(
        self,
        celsius: Float[np.ndarray, "h w"],
        depth_m: Float[np.ndarray, "h w"],
        focus_m: float,
        focal: float,
        rays_per_side: int,
    ) -> Float[np.ndarray, "h2 w2"]:
        """The radiance that the detector's pixels collect, W/(m² sr).

        Args:
            celsius: temperatures along the rays.
            depth_m: z-depth along the rays, metres; 0 for what is infinitely far away.
            focus_m: distance in focus; 0 for infinity.
            focal: focal length in units of the rays' spacing.
            rays_per_side: of the rays of a pixel of the written image.
        """
        nearness, focused = (
            np.divide(1.0, metres, out=np.zeros_like(metres), where=metres > 0)
            for metres in (depth_m, np.array(focus_m))
        )
        radius = focal * self.aperture_mm / 2000.0 * np.abs(nearness - focused)
        side = rays_per_side * self.enlargement
        return block_means(through_lens(band_radiance(celsius), radius, self.cutoff / side), side)


@dataclass(frozen=True, eq=False)
class Detector:
    """What is the same in all photos of one detector.

    Attributes:
        imager: the camera that it is in.
        reference_c: temperature at which the offsets apply.
        shading_c: offset of each pixel by its place, of mean 0.
        pattern_c: offset of each pixel and column by chance.
        replaced: pixels whose values are their neighbours' mean.
        hot: pixels that read ``HOT_PIXEL_C`` too much.
        dead: pixels that always read the reference temperature.
    """

    imager: ThermalImager
    reference_c: float
    shading_c: Float[np.ndarray, "h w"]
    pattern_c: Float[np.ndarray, "h w"]
    replaced: Bool[np.ndarray, "h w"]
    hot: Bool[np.ndarray, "h w"]
    dead: Bool[np.ndarray, "h w"]

    @classmethod
    def of(
        cls,
        imager: ThermalImager,
        size: tuple[int, int],
        reference_c: float,
        rng: np.random.Generator,
    ) -> Detector:
        """A detector of so many rows and columns, drawn at random."""
        pattern = rng.normal(0.0, imager.pattern_c, size) + rng.normal(
            0.0, imager.column_c, size[1]
        )
        defective = rng.random(size) < imager.defective
        missed = defective & (rng.random(size) < imager.missed)
        hot = missed & (rng.random(size) < 0.5)
        shading = imager.shading_c * low_order_shading(size, rng)
        return cls(imager, reference_c, shading, pattern, defective & ~missed, hot, missed & ~hot)

    def photo(
        self,
        radiance: Float[np.ndarray, "h w"],
        drift_c: float,
        beside: UInt8[np.ndarray, "h2 w2 3"],
        rng: np.random.Generator,
    ) -> Float[np.ndarray, "h2 w2"]:
        """The written image, °C.

        Args:
            radiance: that the detector's pixels collect.
            drift_c: offset of the whole photo.
            beside: the photo of the camera beside it.
            rng: of the noise.
        """
        imager = self.imager
        noise = rng.normal(0.0, imager.netd_c, radiance.shape)
        added_c = drift_c + self.shading_c + self.pattern_c + noise + HOT_PIXEL_C * self.hot
        signal = radiance + radiance_per_degree(self.reference_c) * added_c
        signal[self.dead] = band_radiance(np.array(self.reference_c))
        celsius = temperature(replaced(signal, self.replaced))
        image = enlarged(celsius, imager.enlargement)
        blurred = gaussian_filter(image, SHARPENING_PX * imager.enlargement)
        image = image + imager.sharpening * (image - blurred)
        if imager.edges_c:
            image = image + imager.edges_c * edges(beside)
        return image


def low_order_shading(size: tuple[int, int], rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Polynomial of degree 4 and mean 0 that is 1 less at the corners' mean than at the centre:
    vignetting, steeper towards the corners and somewhat lopsided."""
    height, width = size
    y, x = np.meshgrid(
        (np.arange(height) + 0.5) * 2.0 / height - 1.0,
        (np.arange(width) + 0.5) * 2.0 / width - 1.0,
        indexing="ij",
    )
    along_x, along_y, twist, astigmatism = rng.normal(0.0, 0.15, 4)
    lopsided = along_x * x + along_y * y + twist * x * y + astigmatism * (x * x - y * y)
    outwards = (x * x + y * y) / 2.0
    shading = lopsided - 0.6 * outwards - 0.4 * outwards**2
    return shading - shading.mean()


def replaced(
    values: Float[np.ndarray, "h w"], where: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"]:
    """The values, of which some are replaced by the mean of the others around."""
    if not where.any() or where.all():
        return values
    sound = np.where(where, 0.0, 1.0)
    around, weight = (
        gaussian_filter(each, 0.7, mode="nearest", truncate=10.0)
        for each in (values * sound, sound)
    )
    return np.where(where, around / np.maximum(weight, 1e-300), values)


def enlarged(image: Float[np.ndarray, "h w"], times: int) -> Float[np.ndarray, "h2 w2"]:
    """The image with so many times as many rows and columns, by linear interpolation."""
    if times == 1:
        return image
    larger: Float[np.ndarray, "h2 w2"] = zoom(image, times, order=1, mode="nearest", grid_mode=True)
    return larger


def edges(photo: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """The fine detail of a photo, −1 to 1."""
    grey = luminance(photo / 255.0)
    detail: Float[np.ndarray, "h w"] = grey - gaussian_filter(grey, EDGE_PX)
    return detail


CameraName = Literal["gaussian", "phone", "phone-edges", "handheld", "wiris-like"]

PHONE = ThermalImager(
    enlargement=4, pitch_um=12.0, f_number=1.1, aperture_mm=1.6, focus_m=0.6, netd_c=0.07,
    pattern_c=0.05, column_c=0.05, shading_c=1.0,
    drift=Drift(ramp_c=0.8, shutter_s=60.0, jump_c=0.4, pauses=1, pause_s=120.0, rest_c=-3.0),
    defective=0.002, missed=0.05, sharpening=0.5, exposure_ev=0.3,
)  # fmt: skip

CAMERAS = {
    "phone": PHONE,
    "phone-edges": replace(PHONE, edges_c=3.0),
    "handheld": ThermalImager(
        enlargement=2, pitch_um=17.0, f_number=1.1, aperture_mm=16.0, netd_c=0.05,
        pattern_c=0.03, column_c=0.02, shading_c=0.8,
        drift=Drift(ramp_c=0.4, jump_c=0.2, pauses=1, rest_c=-3.5),
        defective=0.001, missed=0.03, sharpening=0.8, exposure_ev=0.2,
    ),
    "wiris-like": ThermalImager(
        pitch_um=17.0, f_number=1.25, aperture_mm=10.4, netd_c=0.04,
        pattern_c=0.02, column_c=0.02, shading_c=0.6,
        drift=Drift(ramp_c=0.5, jump_c=0.3, pauses=1, rest_c=-5.0),
        defective=0.001, missed=0.02, sharpening=0.3, exposure_ev=0.2,
    ),
}  # fmt: skip
"""By name; "gaussian" is not among them: it is the stage's own ``ThermalSensor``."""


def named_imager(camera: CameraName | ThermalImager) -> ThermalImager | None:
    """The camera of this name; None for "gaussian".

    Raises:
        ConfigError: there is none.
    """
    if isinstance(camera, ThermalImager):
        return camera
    if camera not in get_args(CameraName):
        raise ConfigError(f"unknown camera {camera}: choose of {', '.join(get_args(CameraName))}")
    return CAMERAS.get(camera)
