"""The nouns: cameras, views, temperatures, Gaussians. Nothing here opens a file or prints."""

from mrgs.scene.arrays import Array
from mrgs.scene.camera import Camera
from mrgs.scene.gaussians import Gaussians
from mrgs.scene.modality import (
    BUILT_IN,
    RGB,
    THERMAL,
    Modality,
    in_order,
    known_modalities,
    metric_first,
    modality_named,
    register_modality,
)
from mrgs.scene.point_cloud import PointCloud
from mrgs.scene.radiometry import TemperatureRange
from mrgs.scene.rendering import NOT_COARSER, Blend, CameraResponse, Rendering, ideal_cameras
from mrgs.scene.scene import Scene
from mrgs.scene.view import Pixels, PosedImage, View, evenly_spaced
from mrgs.scene.world import Box, EarthPosition, SceneBounds, WorldFrame

__all__ = [
    "BUILT_IN",
    "NOT_COARSER",
    "RGB",
    "THERMAL",
    "Array",
    "Blend",
    "Box",
    "Camera",
    "CameraResponse",
    "EarthPosition",
    "Gaussians",
    "Modality",
    "Pixels",
    "PointCloud",
    "PosedImage",
    "Rendering",
    "Scene",
    "SceneBounds",
    "TemperatureRange",
    "View",
    "WorldFrame",
    "evenly_spaced",
    "ideal_cameras",
    "in_order",
    "known_modalities",
    "metric_first",
    "modality_named",
    "register_modality",
]
