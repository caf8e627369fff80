"""What a generated scene consists of; each scene kind is one file that returns a Stage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float, UInt8

from mrgs_synth.cameras import CameraArc
from mrgs_synth.sensor import ThermalSensor
from mrgs_synth.shapes import Mesh, rotation_z

TemperatureField: TypeAlias = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, " n"]]


def constant(celsius: float) -> TemperatureField:
    """One temperature everywhere, °C."""
    return lambda points: np.full(len(points), celsius)


@dataclass(frozen=True, eq=False)
class Material:
    """How a surface looks.

    Attributes:
        texture: sRGB image; for a metal the colour of its reflection.
        finish: ``matte`` scatters evenly; ``glossy`` adds a coat that reflects; ``metal`` only
            reflects.
        roughness: of the reflection (Beckmann's alpha); not used by matte surfaces.
        infrared_lift: how far its near-infrared reflectance lies on the way from its strongest
            colour to white, 0 to 1; None for what suits the finish (``bands``).
        emissivity: in the thermal infrared, 0 to 1; what is not emitted is reflected.
        heat_mirror: whether heat is reflected as by a mirror (polished metal, glass) or scattered
            evenly (``radiometry``); without effect at an emissivity of 1.
    """

    texture: UInt8[np.ndarray, "h w 3"]
    finish: Literal["matte", "glossy", "metal"] = "matte"
    roughness: float = 0.1
    infrared_lift: float | None = None
    emissivity: float = 1.0
    heat_mirror: bool = False


@dataclass(frozen=True, eq=False)
class Solid:
    """A surface of the scene: a mesh in its own frame, its look, its temperature, and its place.

    Attributes:
        name: unique in the scene.
        mesh: the surface in its own frame, metres.
        material: its look.
        temperature_c: exact temperature in °C of points given in the mesh's frame.
        position: where the frame's origin lies in the world, metres.
        yaw_deg: rotation about the vertical axis.
    """

    name: str
    mesh: Mesh
    material: Material
    temperature_c: TemperatureField
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_deg: float = 0.0

    def world_mesh(self) -> Mesh:
        """The mesh in world coordinates."""
        return self.mesh.placed(*self.position, self.yaw_deg)

    def temperature_at(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Temperature of points of the surface given in world coordinates, °C."""
        return self.temperature_c((points - np.array(self.position)) @ rotation_z(self.yaw_deg))


@dataclass(frozen=True)
class Lamp:
    """A rectangular lamp: centre and the point that it faces in metres, its size, and its radiance
    per colour."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    size_m: tuple[float, float]
    radiance: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Stage:
    """A whole scene, ready to be photographed.

    Attributes:
        solids: every surface.
        lamps: the lamps; no camera may see one.
        sky: radiance that comes from beyond the solids; None indoors. One value per colour, or a
            panorama [h, w, 3] whose rows run from the zenith to the nadir and whose columns run
            once around, clockwise from +y.
        exposure: factor on the radiance before the sRGB curve; 1 turns into white. None: metered.
        cameras: where the camera moves.
        beyond_c: temperature seen where no surface is, °C, for unit vectors that point there.
        point_noise_m: standard deviation of the sparse points' positions, metres.
        surroundings_c: mean temperature that a rough surface faces, °C, for unit normals.
        sensor: the thermal camera.
        bounces: of the light in the photos, after it has left a lamp.
        denoised: whether the noise of path tracing is removed from the photos.
    """

    solids: tuple[Solid, ...]
    lamps: tuple[Lamp, ...]
    sky: tuple[float, float, float] | Float[np.ndarray, "h w 3"] | None
    exposure: float | None
    cameras: CameraArc
    beyond_c: TemperatureField
    point_noise_m: float = 0.002
    surroundings_c: TemperatureField = field(default_factory=lambda: constant(20.0))
    sensor: ThermalSensor = field(default_factory=ThermalSensor)
    bounces: int = 4
    denoised: bool = False
