"""The nouns: cameras, views, temperatures, Gaussians. Nothing here opens a file or prints."""

from mrgs.scene.camera import Camera
from mrgs.scene.gaussians import Gaussians
from mrgs.scene.reach import Reach, reach
from mrgs.scene.scene import PointCloud, Scene
from mrgs.scene.temperature import TemperatureRange
from mrgs.scene.view import Pixels, PosedImage, View, spread

__all__ = [
    "Camera",
    "Gaussians",
    "Pixels",
    "PointCloud",
    "PosedImage",
    "Reach",
    "Scene",
    "TemperatureRange",
    "View",
    "reach",
    "spread",
]
