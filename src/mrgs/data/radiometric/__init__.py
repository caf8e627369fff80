"""Thermal photos of many makers in; temperatures in °C, masks, and the cameras' notes out."""

from mrgs.data.radiometric.exif import ExifFacts, GpsPosition, read_exif
from mrgs.data.radiometric.photo import Overrides, PhotoFacts, ThermalPhoto, VisibleImage
from mrgs.data.radiometric.read import read_thermal_photo
from mrgs.scene.radiometry import ObjectParameters

__all__ = [
    "ExifFacts",
    "GpsPosition",
    "ObjectParameters",
    "Overrides",
    "PhotoFacts",
    "ThermalPhoto",
    "VisibleImage",
    "read_exif",
    "read_thermal_photo",
]
