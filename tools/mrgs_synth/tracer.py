"""The colour photos: path tracing by Mitsuba 3 (optional extra ``synth``)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from mrgs.data.ply import write_ply
from mrgs.errors import ConfigError
from mrgs.scene import Camera
from mrgs_synth.colors import luminance, to_srgb
from mrgs_synth.denoise import Guide, denoised
from mrgs_synth.shapes import Mesh
from mrgs_synth.stage import Lamp, Material, Stage

METER_SAMPLES = 16
SHOTS = 4
"""Pictures of a quarter of the samples each, of which a photo without noise is made."""


class PathTracer:
    """Photographs a stage. The same seed gives the same picture, whatever the number of threads."""

    def __init__(self, stage: Stage, folder: Path) -> None:
        """Hand the stage to Mitsuba.

        Args:
            stage: what to photograph.
            folder: an existing folder for the meshes, needed only during this call.

        Raises:
            ConfigError: Mitsuba is not installed.
        """
        self._mitsuba = load_mitsuba()
        self._guide = Guide(stage.solids) if stage.denoised else None
        self._exposure = 1.0 if stage.exposure is None else stage.exposure
        description: dict[str, Any] = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": stage.bounces + 1},
        }
        if stage.sky is not None:
            description["sky"] = self._sky(stage.sky)
        for number, lamp in enumerate(stage.lamps):
            description[f"lamp_{number}"] = self._lamp(lamp)
        for number, solid in enumerate(stage.solids):
            path = folder / f"{number}.ply"
            _write_mesh(path, solid.world_mesh())
            description[f"solid_{number}"] = {
                "type": "ply",
                "filename": str(path),
                "bsdf": self._bsdf(solid.material),
            }
        # Otherwise the lamps' order, and with it the noise, would change from run to run.
        self._scene = self._mitsuba.load_dict(description, parallel=False, optimize=False)

    def photograph(
        self, camera: Camera, samples: int, seed: int, exposed: float = 1.0
    ) -> UInt8[np.ndarray, "h w 3"]:
        """An sRGB photo with the mean of ``samples`` paths per pixel, exposed so many times as much
        as the others."""
        exposure = exposed * self._exposure
        if self._guide is None or samples < SHOTS:
            return to_srgb(exposure * self._radiance(camera, samples, seed))
        shots = [self._radiance(camera, samples // SHOTS, SHOTS * seed + n) for n in range(SHOTS)]
        return to_srgb(exposure * denoised(np.stack(shots), self._guide.of(camera)))

    def meter(self, cameras: Sequence[Camera], seed: int) -> float:
        """Choose one exposure for all photos, as a camera's light meter does, from small pictures
        by some cameras: half of the pixels above a fifth of white, few above white."""
        small = [camera.resized(32, 24) for camera in cameras]
        radiance = np.stack([self._radiance(camera, METER_SAMPLES, seed) for camera in small])
        middle, bright = np.quantile(luminance(radiance), [0.5, 0.96])
        self._exposure = float(min(0.22 / max(middle, 1e-9), 0.95 / max(bright, 1e-9)))
        return self._exposure

    def _radiance(self, camera: Camera, samples: int, seed: int) -> Float[np.ndarray, "h w 3"]:
        radiance = self._mitsuba.render(
            self._scene, sensor=self._sensor(camera), spp=samples, seed=seed
        )
        return np.array(radiance, dtype=np.float64)

    def _sensor(self, camera: Camera) -> Any:
        to_world = np.linalg.inv(camera.viewmat.numpy()) @ np.diag(
            [-1.0, -1.0, 1.0, 1.0]
        )  # Mitsuba: x left, y up
        fov_deg = 2.0 * np.degrees(np.arctan(camera.width / 2 / camera.K[0, 0].item()))
        film = {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "pixel_format": "rgb",
        }
        film |= {
            "component_format": "float32",
            "rfilter": {"type": "box"},
        }  # no pixel depends on the order of threads
        return self._mitsuba.load_dict(
            {
                "type": "perspective",
                "fov": float(fov_deg),
                "fov_axis": "x",
                "near_clip": 1e-3,
                "to_world": self._mitsuba.ScalarTransform4f(to_world),
                "film": film,
                "sampler": {"type": "multijitter"},
            }
        )

    def _sky(self, sky: tuple[float, float, float] | Float[np.ndarray, "h w 3"]) -> dict[str, Any]:
        if isinstance(sky, tuple):
            return {"type": "constant", "radiance": {"type": "rgb", "value": list(sky)}}
        panorama = self._mitsuba.Bitmap(np.array(sky, dtype=np.float32))
        upright = self._mitsuba.ScalarTransform4f().rotate([1, 0, 0], 90.0)  # Mitsuba: y up
        return {"type": "envmap", "bitmap": panorama, "to_world": upright}

    def _lamp(self, lamp: Lamp) -> dict[str, Any]:
        transform = self._mitsuba.ScalarTransform4f
        half = [lamp.size_m[0] / 2, lamp.size_m[1] / 2, 1.0]
        up = [0.1, 1.0, 0.0]  # of no matter, but never along the direction of light
        return {
            "type": "rectangle",
            "to_world": transform().look_at(list(lamp.position), list(lamp.target), up)
            @ transform().scale(half),
            "emitter": {
                "type": "area",
                "radiance": {"type": "rgb", "value": list(lamp.radiance)},
                "sampling_weight": _irradiance(lamp),
            },
        }

    def _bsdf(self, material: Material) -> dict[str, Any]:
        # Mitsuba's v axis points down the rows.
        texture = {
            "type": "bitmap",
            "bitmap": self._mitsuba.Bitmap(np.array(material.texture[::-1])),
        }
        if material.finish == "metal":
            return {
                "type": "roughconductor",
                "alpha": material.roughness,
                "specular_reflectance": texture,
            }
        if material.finish == "glossy":
            return {
                "type": "roughplastic",
                "alpha": material.roughness,
                "diffuse_reflectance": texture,
            }
        return {"type": "diffuse", "reflectance": texture}


def load_mitsuba() -> Any:
    """Mitsuba in its ``scalar_rgb`` variant, the only one that needs no LLVM library and no GPU.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import mitsuba
    except ImportError as error:
        raise ConfigError(
            'generating a scene needs Mitsuba 3: pip install -e ".[synth]"'
        ) from error
    mitsuba.set_variant("scalar_rgb")
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    return mitsuba


def _irradiance(lamp: Lamp) -> float:
    """About how strongly a lamp lights its target: lamps sampled in this proportion leave the least
    noise."""
    area = lamp.size_m[0] * lamp.size_m[1]
    distance = np.subtract(lamp.target, lamp.position)
    return float(np.mean(lamp.radiance) * area / (distance @ distance + area / np.pi))


def _write_mesh(path: Path, mesh: Mesh) -> None:
    """Write a triangle mesh with normals and texture coordinates as a PLY file."""
    values = np.concatenate([mesh.vertices, mesh.normals, mesh.uv], axis=1).astype(np.float32)
    names = ("x", "y", "z", "nx", "ny", "nz", "u", "v")
    columns = {name: values[:, i] for i, name in enumerate(names)}
    write_ply(path, {"vertex": columns, "face": mesh.faces})
