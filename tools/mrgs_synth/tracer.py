"""The colour photos: path tracing by Mitsuba 3 (optional extra ``synth``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from mrgs.data.ply import table, write_ply
from mrgs.errors import ConfigError
from mrgs.scene import Camera
from mrgs_synth.shapes import Mesh
from mrgs_synth.stage import Lamp, Material, Stage

MAX_BOUNCES = 4


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
        self._exposure = stage.exposure
        description: dict[str, Any] = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": MAX_BOUNCES + 1},
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

    def photograph(self, camera: Camera, samples: int, seed: int) -> UInt8[np.ndarray, "h w 3"]:
        """An sRGB photo with the mean of ``samples`` paths per pixel."""
        radiance = self._mitsuba.render(
            self._scene, sensor=self._sensor(camera), spp=samples, seed=seed
        )
        return to_srgb(self._exposure * np.array(radiance, dtype=np.float64))

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
            'generating a scene needs Mitsuba 3: pip install "mrgs[synth]"'
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


def to_srgb(linear: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Linear light -> 8-bit sRGB (IEC 61966-2-1); what lies outside [0, 1] is clipped."""
    value = linear.clip(0.0, 1.0)
    curve = np.where(
        value <= 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 1e-9) ** (1 / 2.4) - 0.055
    )
    return np.round(255.0 * curve).astype(np.uint8)


def from_srgb(value: UInt8[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """8-bit sRGB -> linear light; the inverse of ``to_srgb``."""
    share = value / 255.0
    linear: Float[np.ndarray, "*shape"] = np.where(
        share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4
    )
    return linear


def _write_mesh(path: Path, mesh: Mesh) -> None:
    """Write a triangle mesh with normals and texture coordinates as a PLY file."""
    values = np.concatenate([mesh.vertices, mesh.normals, mesh.uv], axis=1).astype(np.float32)
    names = ("x", "y", "z", "nx", "ny", "nz", "u", "v")
    columns = {name: values[:, i] for i, name in enumerate(names)}
    write_ply(path, {"vertex": table(columns), "face": mesh.faces})
