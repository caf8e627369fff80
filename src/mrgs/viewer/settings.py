"""What is looked at, and how one browser shows it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mrgs.pictures.palette import PaletteName
from mrgs.scene import (
    RGB,
    THERMAL,
    Camera,
    CameraResponse,
    Modality,
    Scene,
    TemperatureRange,
    View,
    ideal_cameras,
)
from mrgs.viewer.source import Source

Mode = Literal[
    "rgb", "temperature", "depth", "side_by_side", "blend", "split", "photos", "difference"
]

MODE_LABELS: dict[Mode, str] = {
    "temperature": "Temperature",
    "rgb": "Colour",
    "depth": "Depth",
    "side_by_side": "Colour | temperature, side by side",
    "blend": "Temperature over colour (slider)",
    "split": "Colour left, temperature right (slider)",
    "photos": "Photos beside the model",
    "difference": "Difference to the thermal photo",
}
"""What the panel calls the modes, in its order."""

PALETTE_CHOICES: tuple[PaletteName, ...] = ("inferno", "iron", "grey", "rainbow")


@dataclass(frozen=True)
class Settings:
    """The choices that a picture depends on.

    Attributes:
        mode: what is shown.
        palette: colours of the temperatures.
        limits: temperatures of the palette's ends, °C (normalised without °C); None follows the
            picture.
        isotherm: temperatures from-to that are marked in one colour; None marks nothing.
        share: of the slider in the modes ``blend`` and ``split``, 0 (all colour) to 1 (all
            temperature).
    """

    mode: Mode = "temperature"
    palette: PaletteName = "inferno"
    limits: tuple[float, float] | None = None
    isotherm: tuple[float, float] | None = None
    share: float = 0.5


@dataclass(frozen=True, eq=False)
class Subject:
    """The model that is shown, and what is known of it.

    Attributes:
        name: of the run, for the title.
        source: gives access to the model.
        temperature: the scale of the thermal values; None without known °C.
        scene: the capture, for its cameras and photos; None where it cannot be had.
        folder: the run's folder; screenshots and videos go into its ``renders``.
        note: a sentence for the user at the top of the panel; may be empty.
        camera_response: what the captured cameras do to the images; used where the model is
            compared with photos.
    """

    name: str
    source: Source
    temperature: TemperatureRange | None
    scene: Scene | None
    folder: Path
    note: str = ""
    camera_response: CameraResponse = ideal_cameras

    @property
    def unit(self) -> str:
        """Of the thermal values: °C, or what stands in for it."""
        return "normalised" if self.temperature is None else "°C"

    @property
    def modalities(self) -> tuple[Modality, ...]:
        """Those that are shown: colour and temperature, as far as there were training photos of
        them; both are assumed where the scene is not at hand."""
        if self.scene is None:
            return (RGB, THERMAL)
        return tuple(each for each in self.scene.modalities if each in (RGB, THERMAL))

    @property
    def has_thermal(self) -> bool:
        """Whether the model has temperatures."""
        return THERMAL in self.modalities

    def cameras(self, camera: Camera) -> dict[Modality, Camera]:
        """One camera for every modality that is shown."""
        return dict.fromkeys(self.modalities, camera)

    @property
    def views(self) -> tuple[View, ...]:
        """The captured views: those trained on, then those held out."""
        return () if self.scene is None else (*self.scene.train, *self.scene.eval)

    @property
    def modes(self) -> tuple[Mode, ...]:
        """The modes that the run's modalities and photos allow, in the panel's order."""
        needs = {
            RGB: {"rgb", "side_by_side", "blend", "split"},
            THERMAL: {"temperature", "side_by_side", "blend", "split", "difference"},
        }
        needs_photos = {"photos", "difference"}
        return tuple(
            mode
            for mode in MODE_LABELS
            if all(mode not in modes or each in self.modalities for each, modes in needs.items())
            and (self.views or mode not in needs_photos)
        )

    def format_value(self, value: float) -> str:
        """A thermal value as text, with °C where it is known."""
        text = f"{value:.3f}" if self.temperature is None else f"{value:.1f} °C"
        return text.replace("-", "−")
