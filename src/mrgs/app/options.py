"""Types of options, and options that several commands share; the docstrings are what ``--help``
prints."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import tyro

from mrgs.export.formats import FORMATS
from mrgs.runs.registry import registered_methods

if TYPE_CHECKING:
    from mrgs.prepare import PrepareOptions

METHOD_NAMES = [each.name for each in registered_methods()]
METHODS_HELP = "; ".join(f"{each.name}: {each.description}" for each in registered_methods())

FORMATS_HELP = "all, or one of: " + "; ".join(
    f"{each.name}: {each.files}" for each in FORMATS.values()
)

DeviceName = Literal["auto", "cpu", "cuda"]
"""As in ``mrgs.system.gpu``, which loads torch."""

QualityName = Literal["fast", "default", "best"]
"""As in ``mrgs.pipeline.quality``, which loads torch."""

PaletteChoice = Literal["inferno", "iron", "grey", "black-hot", "rainbow", "arctic", "lava"]
"""As in ``mrgs.pictures.page_data``, which loads torch; grey is white-hot."""

T = TypeVar("T")

Maybe = Annotated[T | None, tyro.conf.arg(help_behavior_hint="")]
"""An option that may be left out; the help does not list its default, None."""

Several = Annotated[tuple[T, ...], tyro.conf.arg(help_behavior_hint="")]
"""An option with any number of values, by default none."""

PresetName = Annotated[str, tyro.conf.arg(metavar="{fast,default,paper}")]
FormatName = Annotated[
    str, tyro.conf.arg(metavar="{" + ",".join(["all", *FORMATS]) + "}", help=FORMATS_HELP)
]
MethodName = Annotated[
    str, tyro.conf.arg(metavar="{" + ",".join(METHOD_NAMES) + "}", help=METHODS_HELP)
]
RunPath = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
ScenePath = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCENE")]


@dataclass(frozen=True)
class PhotoOptions:
    """Facts about the photos that their files do not hold."""

    pairs: Literal["auto", "names", "folders", "time", "thermal"] = "auto"
    """How photos are paired: by file names, two folders or time; thermal: thermal photos only."""
    pair_table: Maybe[Path] = None
    """CSV file with the columns rgb and thermal, if pairs cannot be inferred from file names."""
    tolerance: float = 2.0
    """Maximum time difference within a pair, in seconds."""
    poses: Maybe[Path] = None
    """Folder with poses of these photos from COLMAP or nerfstudio; they are used as they are."""
    emissivity: Maybe[float] = None
    """Surface emissivity. This and the next six options override the values in the photos."""
    reflected: Maybe[float] = None
    """Reflected apparent temperature, °C."""
    distance: Maybe[float] = None
    """Distance from the camera to the object, m."""
    atmospheric: Maybe[float] = None
    """Air temperature, °C."""
    humidity: Maybe[float] = None
    """Relative humidity of the air, 0 to 1."""
    window: Maybe[float] = None
    """Temperature of an infrared window in front of the camera, °C."""
    window_transmission: Maybe[float] = None
    """Transmission of that window, 0 to 1."""
    unit: Maybe[str] = None
    """Unit of the values in TIFF, PNG and CSV files, such as celsius or kelvin*100."""
    bounds: Maybe[tuple[float, float]] = None
    """Temperatures (°C) of black and white, for greyscale thermal photos with a fixed span."""
    thermal_fov: Maybe[float] = None
    """Horizontal field of view of the thermal camera in degrees, from its data sheet."""
    thermal_camera: Maybe[Path] = None
    """JSON file with the thermal camera, or another scene's transforms.json (docs/prepare.md)."""
    one_camera: bool = False
    """The two images of a pair show the same scene, pixel for pixel."""
    target: Maybe[tuple[str, float]] = None
    """Chessboard that both cameras see: inner corners and square size in m, such as 7x6 0.05."""
    known_distance: Maybe[tuple[str, str, float]] = None
    """Two pixels of one view and the distance between their points: NAME:X,Y NAME:X,Y METRES."""
    eval_every: int = 8
    """Hold out every Nth view for evaluation; 0 holds out none."""

    def options(self) -> PrepareOptions:
        """The options of ``prepare``.

        Raises:
            ConfigError: an invalid value, or two options that exclude each other.
        """
        from mrgs.data.radiometric import Overrides
        from mrgs.prepare import PrepareOptions, parse_known_distance, parse_target

        return PrepareOptions(
            overrides=Overrides(
                emissivity=self.emissivity,
                distance_m=self.distance,
                reflected_c=self.reflected,
                atmospheric_c=self.atmospheric,
                humidity=self.humidity,
                window_c=self.window,
                window_transmission=self.window_transmission,
                unit=self.unit,
                bounds_c=self.bounds,
            ),
            pairs=self.pairs,
            pair_table=self.pair_table,
            tolerance_s=self.tolerance,
            poses=self.poses,
            one_camera=self.one_camera,
            thermal_fov_deg=self.thermal_fov,
            thermal_camera=self.thermal_camera,
            target=None if self.target is None else parse_target(*self.target),
            known_distance=None
            if self.known_distance is None
            else parse_known_distance(*self.known_distance),
            eval_every=self.eval_every,
        )
