"""A drone's survey flight: parallel lines to and fro, photos at even distances, noisy GPS."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np
from jaxtyping import Float
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from mrgs.data.earth import geodetic
from mrgs.scene import Camera, EarthPosition

ORIGIN = EarthPosition(48.137, 11.575, 520.0)
"""Of the scene's coordinates: metres east, north and up from here."""

HEIGHT_M = 20.0
"""Above the origin."""

FOV_DEG = 43.6
"""Horizontal: 16 m on the ground, 5 cm per pixel in an image of 320 pixels."""

FORWARD_DEG = 10.0
"""By which the camera looks ahead of straight down."""

BORDER_M = 3.0
"""By which the lines go beyond the tables."""

JITTER_M, JITTER_DEG = 0.25, 1.5
"""Standard deviation of each coordinate of the camera, and of each of its angles."""

TAKE_OFF = datetime(2025, 6, 21, 12, 0)
INTERVAL_S = 2.0


@dataclass(frozen=True, eq=False)
class Flight:
    """Photos in the order of the flight.

    Attributes:
        cameras: by the name of the frame.
        gps_m: positions by GPS, scene coordinates, in the order of the cameras, [V, 3].
    """

    cameras: dict[str, Camera]
    gps_m: Float[np.ndarray, "v 3"]

    @property
    def gps_residual_m(self) -> float:
        """Median distance of the positions by GPS from the cameras."""
        places = np.stack([camera.position.numpy() for camera in self.cameras.values()])
        return float(np.median(np.linalg.norm(self.gps_m - places, axis=1)))


def footprint_m(width: int, height: int) -> tuple[float, float]:
    """Width and height of a photo on the ground."""
    across = 2.0 * HEIGHT_M * float(np.tan(np.radians(FOV_DEG) / 2))
    return across, across * height / width


def survey(
    low: tuple[float, float],
    high: tuple[float, float],
    overlap: float,
    size: tuple[int, int],
    eval_views: int,
    gps_noise_m: float,
    rng: np.random.Generator,
) -> Flight:
    """A flight over a rectangle, along x.

    Evaluation views lie between two training views of a line, a quarter of the distance of the
    lines to the side.

    Args:
        low: smallest x and y of what is surveyed, metres.
        high: largest x and y.
        overlap: of neighbouring photos and lines, a share of the photo.
        size: width and height of the photos in pixels.
        eval_views: evenly spread over the flight.
        gps_noise_m: standard deviation of each coordinate.
        rng: of all that strays.
    """
    across, along = footprint_m(*size)
    lines = _spaced(low[1] - BORDER_M, high[1] + BORDER_M, (1.0 - overlap) * across)
    stops = _spaced(low[0] - BORDER_M, high[0] + BORDER_M, (1.0 - overlap) * along)
    places = [
        (x, y, 0.0 if number % 2 == 0 else np.pi)
        for number, y in enumerate(lines)
        for x in (stops if number % 2 == 0 else stops[::-1])
    ]
    starts = [n for n in range(len(places) - 1) if (n + 1) % len(stops) != 0]
    chosen = [starts[int((n + 0.5) * len(starts) / eval_views)] for n in range(eval_views)]
    aside = 0.25 * (lines[1] - lines[0])
    between = [
        (
            (places[n][0] + places[n + 1][0]) / 2,
            places[n][1] + (aside if places[n][1] < lines[-1] else -aside),
            places[n][2],
        )
        for n in chosen
    ]
    cameras = {
        f"frame_{split}_{number:05d}": _camera(place, size, rng)
        for split, those in (("train", places), ("eval", between))
        for number, place in enumerate(those, start=1)
    }
    positions = np.stack([camera.position.numpy() for camera in cameras.values()])
    return Flight(cameras, positions + rng.normal(0.0, gps_noise_m, positions.shape))


def gps_exif(position_m: Float[np.ndarray, "3"], number: int) -> bytes:
    """The EXIF data of photo ``number`` of a flight, taken at a place (scene coordinates)."""
    place = geodetic(position_m, ORIGIN)
    exif = Image.Exif()
    exif[Base.Make], exif[Base.Model] = "mrgs", "synthetic drone"
    taken = (TAKE_OFF + timedelta(seconds=INTERVAL_S * number)).strftime("%Y:%m:%d %H:%M:%S")
    exif[Base.DateTime] = taken
    exif.get_ifd(IFD.Exif)[Base.DateTimeOriginal] = taken
    gps = exif.get_ifd(IFD.GPSInfo)
    gps[GPS.GPSLatitudeRef], gps[GPS.GPSLatitude] = "N", _sexagesimal(place.latitude_deg)
    gps[GPS.GPSLongitudeRef], gps[GPS.GPSLongitude] = "E", _sexagesimal(place.longitude_deg)
    gps[GPS.GPSAltitudeRef], gps[GPS.GPSAltitude] = b"\x00", round(place.altitude_m or 0.0, 3)
    return exif.tobytes()


def _sexagesimal(degrees: float) -> tuple[float, float, float]:
    minutes, seconds = divmod(3600.0 * degrees, 60.0)
    whole, minutes = divmod(minutes, 60.0)
    return whole, minutes, round(seconds, 5)  # 0.3 mm


def _spaced(first: float, last: float, most: float) -> Float[np.ndarray, " n"]:
    """Two or more numbers with at most this distance, from the first to the last."""
    return np.linspace(first, last, max(int(np.ceil((last - first) / most)), 1) + 1)


def _camera(
    place: tuple[float, float, float], size: tuple[int, int], rng: np.random.Generator
) -> Camera:
    """A camera over a place (x, y) that flies in a direction, in radians from the x axis."""
    x, y, heading = place
    position = np.array([x, y, HEIGHT_M]) + rng.normal(0.0, JITTER_M, 3)
    turn, tilt, roll = np.radians(rng.normal(0.0, JITTER_DEG, 3))
    ahead = np.array([np.cos(heading + turn), np.sin(heading + turn), 0.0])
    aside = np.array([-ahead[1], ahead[0], 0.0])
    forward = np.tan(np.radians(FORWARD_DEG) + tilt) * ahead + np.tan(roll) * aside
    target = position + forward - np.array([0.0, 0.0, 1.0])
    return Camera.from_fov(*size, FOV_DEG).look_at(position, target, ahead)
