"""The model that the viewer shows, and how one browser shows it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from mrgs.pictures.page_data import starting_limits
from mrgs.pictures.palette import PaletteName
from mrgs.pictures.values import capitalised, format_value
from mrgs.render import Model
from mrgs.scene import (
    THERMAL,
    Camera,
    CameraResponse,
    Modality,
    Scene,
    TemperatureRange,
    View,
    ideal_cameras,
    in_order,
    metric_first,
)
from mrgs.viewer.board import MarkBoard
from mrgs.viewer.source import Source

Kind = Literal[
    "image", "depth", "side_by_side", "blend", "split", "photos", "difference", "uncertainty"
]


@dataclass(frozen=True)
class Mode:
    """A way to show a model: ``image``, ``uncertainty`` and ``difference`` (model minus photo) show
    one modality, ``side_by_side``, ``blend`` and ``split`` two, the left or lower one first;
    ``photos`` shows photos beside the model."""

    kind: Kind
    modalities: tuple[Modality, ...] = ()

    @property
    def label(self) -> str:
        """Label of the mode in the panel."""
        words = [modality.quantity for modality in self.modalities]
        match self.kind:
            case "image":
                return capitalised(words[0])
            case "side_by_side":
                return f"{capitalised(words[0])} | {words[1]}, side by side"
            case "blend":
                return f"{capitalised(words[1])} over {words[0]} (slider)"
            case "split":
                return f"{capitalised(words[0])} left, {words[1]} right (slider)"
            case "photos":
                return "Photos beside the model"
            case "uncertainty":
                return f"Uncertainty of the {words[0]} (±)"
            case "difference":
                return f"Difference to the {self.modalities[0].title} photo"
        return "Depth"

    @property
    def shows_photos(self) -> bool:
        """Whether the picture is bound to a captured camera."""
        return self.kind in ("photos", "difference")

    @property
    def scaled(self) -> Modality | None:
        """The modality with a unit whose range, palette and isotherm count in the picture."""
        if self.kind in ("uncertainty", "difference"):
            return None
        return next((each for each in reversed(self.modalities) if each.is_metric), None)


@dataclass(frozen=True)
class Settings:
    """The choices that a picture depends on.

    Attributes:
        palette: colours of values with a unit.
        limits: values of the palette's first and last colour, of each modality in its unit; others
            follow the picture.
        isotherm: first and last value of the band that is marked in one colour, in the unit of
            ``scaled``; None marks nothing.
        share: of the slider: 0 shows only the lower or left image, 1 only the other.
        scaled: the modality that ``isotherm`` applies to.
        marks: whether they are drawn into the picture.
    """

    mode: Mode = Mode("depth")
    palette: PaletteName = "inferno"
    limits: Mapping[Modality, tuple[float, float]] = field(default_factory=dict)
    isotherm: tuple[float, float] | None = None
    share: float = 0.5
    scaled: Modality = THERMAL
    marks: bool = True


@dataclass(frozen=True, eq=False)
class Subject:
    """The model that is shown, and what is known of it.

    Attributes:
        name: of the scene and the run, for the title.
        scene: the capture, for its cameras and photos; None if it is not available.
        folder: the run's folder; screenshots and videos go into its ``renders``.
        note: a sentence for the user at the top of the panel; may be empty.
        camera_response: what the captured cameras do to the images; applied where the model is
            compared with photos.
        board: the marks of the run; None where they cannot be kept.
        uncertainty: that of the temperatures as ``PaneImages`` of a camera; None where it is not
            known.
    """

    name: str
    source: Source
    modalities: tuple[Modality, ...]
    temperature: TemperatureRange | None
    scene: Scene | None
    folder: Path
    note: str = ""
    camera_response: CameraResponse = ideal_cameras
    board: MarkBoard | None = None
    uncertainty: Callable[[Camera], Any] | None = None

    @property
    def scaled(self) -> Modality | None:
        """The modality whose range and isotherm can be chosen: the first with a unit, else None."""
        return next((modality for modality in self.modalities if modality.is_metric), None)

    @cached_property
    def limits(self) -> Mapping[Modality, tuple[float, float]]:
        """The limits that the scale of each modality with a unit is locked at at first."""
        return starting_limits(self.modalities, self.scene, self.temperature)

    @property
    def readable(self) -> tuple[Modality, ...]:
        """The modalities whose values can be read, those with one channel; the first by default."""
        return tuple(modality for modality in self.modalities if modality.channels == 1)

    @property
    def views(self) -> tuple[View, ...]:
        """The captured views: training views first, then held-out ones."""
        return () if self.scene is None else self.scene.views

    @property
    def modes(self) -> tuple[Mode, ...]:
        """The modes that the run's modalities and photos allow, in the panel's order."""
        modes = [Mode("image", (modality,)) for modality in self.modalities]
        modes.append(Mode("depth"))
        if self.uncertainty is not None:
            modes.append(Mode("uncertainty", (THERMAL,)))
        below = next((each for each in self.modalities if not each.is_metric), None)
        if below is not None:
            kinds: tuple[Kind, ...] = ("side_by_side", "blend", "split")
            above = [modality for modality in self.modalities if modality != below]
            modes += [Mode(kind, (below, modality)) for modality in above for kind in kinds]
        if self.views:
            modes.append(Mode("photos", in_order(self.modalities)))
            modes += [Mode("difference", (modality,)) for modality in self.readable]
        return tuple(modes)

    def format_value(self, modality: Modality, value: float) -> str:
        """A value of a modality as text, with its unit if it has one."""
        return format_value(modality, value, self.temperature)

    def format_difference(self, modality: Modality, value: float, *, sign: bool = False) -> str:
        """A difference of two values, or a ±, as text with its unit; sign as of ``number_text``."""
        return in_kelvin(format_value(modality, value, self.temperature, sign=sign))


def shown_modalities(model: Model, scene: Scene | None) -> tuple[Modality, ...]:
    """The modalities to show: all with training photos, the ones with a unit first;
    all of the model's if the scene is not available."""
    modalities = model.gaussians.modalities
    if scene is not None:
        modalities = tuple(each for each in modalities if each in scene.modalities)
    return metric_first(modalities)


def in_kelvin(text: str) -> str:
    """The unit of a difference in place of that of the values."""
    return text.replace("°C", "K")
