"""A generated scene on disk, in ThermoScenes' layout, with its truth beside it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float, UInt, UInt8
from PIL import Image, TiffImagePlugin

from mrgs.data.ply import write_points
from mrgs.data.transforms import (
    BOUNDS,
    POINTS,
    RECORD,
    TRANSFORMS,
    frame_json,
    pinhole_lens,
    world_json,
    write_bounds,
    write_transforms,
)
from mrgs.errors import ConfigError
from mrgs.scene import THERMAL, Camera, Modality, TemperatureRange, WorldFrame
from mrgs.scene.radiometry import PhotoRecord

JPEG_QUALITY = 92
# Truth is rounded to these steps, far below what matters, so that it compresses: 1/512 °C and
# 1/16384 m.
TEMPERATURE_STEP_C = 2.0**-9
DEPTH_STEP_M = 2.0**-14

METRES = WorldFrame(metric=True)


@dataclass(frozen=True)
class SceneFolder:
    """A new scene folder; ``transforms`` completes it, so write that last."""

    path: Path

    @classmethod
    def create(cls, path: Path) -> SceneFolder:
        """Make the folders of a scene.

        Raises:
            ConfigError: ``path`` is a file, holds a scene already, or cannot be written.
        """
        if (path / TRANSFORMS).exists() or any((path / "images").glob("*")):
            raise ConfigError(f"{path} holds a scene already: delete it, or choose another folder")
        try:
            for name in ("images", "thermal", "truth/temperature", "truth/depth"):
                (path / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(
                f"{path} cannot be written ({error.strerror}): choose another folder"
            ) from error
        return cls(path)

    def rgb(self, name: str, photo: UInt8[np.ndarray, "h w 3"], exif: bytes = b"") -> None:
        """Write ``images/NAME.jpg``, with EXIF data if there are any."""
        Image.fromarray(photo).save(
            self.path / f"images/{name}.jpg", quality=JPEG_QUALITY, subsampling=0, exif=exif
        )

    def thermal(self, name: str, grey: UInt[np.ndarray, "h w"]) -> None:
        """Write ``thermal/NAME.png``."""
        Image.fromarray(grey).save(self.path / f"thermal/{name}.png", optimize=True)

    def band(self, modality: Modality, name: str, grey: UInt8[np.ndarray, "h w"]) -> None:
        """Write ``MODALITY/NAME.png``."""
        folder = self.path / modality.name
        folder.mkdir(exist_ok=True)
        Image.fromarray(grey).save(folder / f"{name}.png", optimize=True)

    def truth(
        self, name: str, exact_c: Float[np.ndarray, "h w"], depth_m: Float[np.ndarray, "h w"]
    ) -> None:
        """Write ``truth/temperature/NAME.tiff`` (°C) and ``truth/depth/NAME.tiff`` (z-depth,
        metres), float32."""
        write_float_tiff(self.path / f"truth/temperature/{name}.tiff", exact_c, TEMPERATURE_STEP_C)
        write_float_tiff(self.path / f"truth/depth/{name}.tiff", depth_m, DEPTH_STEP_M)

    def temperature_bounds(self, temperature: TemperatureRange) -> None:
        """Write ``temperature_bounds.json``."""
        write_bounds(self.path / BOUNDS, temperature.min_c, temperature.max_c)

    def points(self, positions: Float[np.ndarray, "n 3"], colors: UInt8[np.ndarray, "n 3"]) -> None:
        """Write ``sparse_pc.ply``."""
        write_points(self.path / POINTS, positions, colors)

    def parameters(self, parameters: Mapping[str, Any]) -> None:
        """Write ``truth/synth.json``: how the scene was generated."""
        text = json.dumps(parameters, indent=1) + "\n"
        (self.path / "truth/synth.json").write_text(text, encoding="utf-8")

    def camera(
        self, parameters: Mapping[str, Any], maps_c: Mapping[str, Float[np.ndarray, "h w"]]
    ) -> None:
        """Write ``truth/camera/camera.json``: what the thermal camera did; and maps of its
        detector, ``truth/camera/NAME.tiff``, °C."""
        folder = self.path / "truth/camera"
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(parameters, indent=1) + "\n"
        (folder / "camera.json").write_text(text, encoding="utf-8")
        for name, values in maps_c.items():
            write_float_tiff(folder / f"{name}.tiff", values, TEMPERATURE_STEP_C)

    def transforms(
        self,
        cameras: Mapping[str, Camera],
        further: Sequence[Modality] = (),
        world: WorldFrame = METRES,
        records: Mapping[str, PhotoRecord] = MappingProxyType({}),
    ) -> None:
        """Write ``transforms.json`` for named cameras that share their intrinsics, for the images
        of further modalities, and with what the thermal camera noted of photos."""
        frames = [
            frame_json(
                camera.viewmat,
                f"images/{name}.jpg",
                {each: f"{each}/{name}.png" for each in (THERMAL, *further)},
            )
            | ({f"{THERMAL}_{RECORD}": records[name].to_json()} if name in records else {})
            for name, camera in cameras.items()
        ]
        lens = pinhole_lens(next(iter(cameras.values())))
        write_transforms(
            self.path / TRANSFORMS,
            frames,
            lens=lens,
            points=POINTS,
            modalities=further,
            facts=world_json(world),
        )


def write_float_tiff(path: Path, values: Float[np.ndarray, "h w"], step: float) -> None:
    """Write a compressed float32 TIFF, its values rounded to a multiple of ``step`` (a power of
    two)."""
    rounded = (np.round(values / step) * step).astype(np.float32)
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[TiffImagePlugin.PREDICTOR] = 3  # for floating-point values
    Image.fromarray(rounded).save(path, compression="tiff_adobe_deflate", tiffinfo=tags)
