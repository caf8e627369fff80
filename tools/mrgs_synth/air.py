"""A scene as if it were larger and photographed from farther away, through air.

    python -m mrgs_synth.air SCENE OUT --metres 50

The scene is enlarged until the median depth is so many metres. Its thermal photos, of all views,
become those of a camera that is set to another distance: what each pixel receives is

    τ(D) L(T) + (1 − τ(D)) L(T_air)

with L the radiance in the band, D the pixel's own distance and τ the transmission of air by FLIR's
formula; the camera computes temperatures from it as if D were the distance that it is set to. The
scene must have exact depths of all views (``synthesize(..., truth="all")``); exact temperatures
stay what they are.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from PIL import Image

from mrgs.data.ply import read_ply, write_points
from mrgs.data.transforms import BOUNDS, POINTS, RECORD, TRANSFORMS, write_bounds
from mrgs.errors import ConfigError
from mrgs.scene.radiometry import ObjectParameters, PhotoRecord
from mrgs_synth.planck import band_radiance, temperature


class Air(NamedTuple):
    """Air of a temperature, °C, and a relative humidity, and the distance that the camera is set
    to, m."""

    celsius: float = 10.0
    humidity: float = 0.5
    noted_m: float = 5.0

    def transmission(self, metres: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        """τ at distances."""
        powers = np.polynomial.Polynomial((1.5587, 0.06939, -2.7816e-4, 6.8455e-7))
        water = np.sqrt(self.humidity * np.exp(powers(self.celsius)))
        first = np.exp(-np.sqrt(metres) * (0.006569 - 0.002276 * water))
        second = np.exp(-np.sqrt(metres) * (0.01262 - 0.00667 * water))
        return 1.9 * first - 0.9 * second

    def read(
        self, celsius: Float[np.ndarray, "h w"], metres: Float[np.ndarray, "h w"]
    ) -> Float[np.ndarray, "h w"]:
        """What the camera says, °C, of surfaces that it would read right from the distance that it
        is set to; pixels at 0 m, which see nothing, stay."""
        tau, noted = self.transmission(metres), self.transmission(np.array(self.noted_m))
        of_air = band_radiance(np.array(self.celsius))
        received = tau * band_radiance(celsius) + (1.0 - tau) * of_air
        read = temperature((received - (1.0 - noted) * of_air) / noted)
        return np.where(metres > 0.0, read, celsius)


def through_air(scene: Path, output: Path, metres: float, air: Air | None = None) -> float:
    """Write the enlarged scene; returns by how much it was enlarged. ConfigError if ``output``
    exists, or the scene has no exact depth of a view or no temperatures."""
    air = air or Air()
    transforms = json.loads((scene / TRANSFORMS).read_text(encoding="utf-8"))
    if output.exists() or not (scene / BOUNDS).is_file():
        raise ConfigError(f"{output} must be new, and {scene} needs temperatures")
    low_c, high_c = sorted(json.loads((scene / BOUNDS).read_text(encoding="utf-8")).values())
    names = {frame["thermal_file_path"]: Path(frame["file_path"]).stem for frame in
             transforms["frames"]}  # fmt: skip
    depths = {name: _depth(scene, name) for name in names.values()}
    scale = metres / float(np.median(np.concatenate([d[d > 0] for d in depths.values()])))
    shutil.copytree(scene, output)
    record = PhotoRecord(
        source="generated",
        parameters=ObjectParameters(1.0, air.noted_m, air.celsius, air.celsius, air.humidity),
    )
    extremes = [low_c, high_c]
    for frame in transforms["frames"]:
        for key in ("transform_matrix", "thermal_transform_matrix"):
            for row in frame.get(key, [])[:3]:
                row[3] *= scale
        old = output / frame["thermal_file_path"]
        depth = depths[names[frame["thermal_file_path"]]]
        read = air.read(
            _celsius(old, low_c, high_c), scale * _ray_lengths(depth, transforms | frame)
        )
        old.unlink()
        new = old.with_suffix(".tiff")
        Image.fromarray(read.astype(np.float32)).save(new)
        extremes += [float(read.min()), float(read.max())]
        frame["thermal_file_path"] = new.relative_to(output).as_posix()
        taken = frame.get(f"thermal_{RECORD}", {})
        frame[f"thermal_{RECORD}"] = {**taken, **record.to_json()}
    for path in (output / "truth" / "depth").iterdir():
        Image.fromarray(scale * np.asarray(Image.open(path))).save(path)
    positions, colors = read_ply(output / POINTS)
    assert colors is not None, "as the generator writes them"
    whole = (255.0 * colors).round().astype(np.uint8)
    write_points(output / POINTS, scale * positions, whole)
    (output / TRANSFORMS).write_text(json.dumps(transforms, indent=1), encoding="utf-8")
    write_bounds(output / BOUNDS, np.floor(min(extremes)), np.ceil(max(extremes)))
    return scale


def _depth(scene: Path, name: str) -> Float[np.ndarray, "h w"]:
    path = scene / "truth" / "depth" / f"{name}.tiff"
    if not path.is_file():
        raise ConfigError(f"{path} is missing: generate the scene with the truth of all views")
    depth: Float[np.ndarray, "h w"] = np.nan_to_num(np.asarray(Image.open(path), np.float64))
    return depth


def _celsius(path: Path, low_c: float, high_c: float) -> Float[np.ndarray, "h w"]:
    values = np.asarray(Image.open(path))
    most = 255 if values.dtype == np.uint8 else 65535
    celsius: Float[np.ndarray, "h w"] = low_c + (high_c - low_c) * values.astype(np.float64) / most
    return celsius


def _ray_lengths(depth: Float[np.ndarray, "h w"], lens: dict) -> Float[np.ndarray, "h w"]:
    """Distances from the camera, of z-depths."""
    rows, columns = (np.arange(side) + 0.5 for side in depth.shape)
    x = (columns - lens["cx"]) / lens["fl_x"]
    y = (rows - lens["cy"]) / lens["fl_y"]
    return depth * np.sqrt(1.0 + x**2 + y[:, None] ** 2)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m mrgs_synth.air", description=__doc__)
    parser.add_argument("scene", type=Path, help="a scene folder with the truth of all views")
    parser.add_argument("output", type=Path, help="the new folder")
    parser.add_argument("--metres", type=float, required=True, help="the median depth")
    options = parser.parse_args(arguments)
    through_air(options.scene, options.output, options.metres)


if __name__ == "__main__":
    main()
