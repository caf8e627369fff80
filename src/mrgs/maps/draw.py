"""An orthographic map: temperatures, colours, their support by photos; and its picture."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias
from xml.etree import ElementTree

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from PIL import Image, ImageDraw

from mrgs.errors import ConfigError, RunError
from mrgs.maps import surfaces
from mrgs.maps.surfaces import Coverage, MapGrid, PhotoStatistics, ShownPlaces
from mrgs.pictures.drawing import INK, MUTED, PAPER, Scale, blank, draw_text, fit_text, scale_bar
from mrgs.pictures.files import to_array
from mrgs.pictures.palette import PaletteName, display_range, palette_table, tick_labels
from mrgs.runs.baked import BakedModel
from mrgs.scene import RGB, THERMAL, Camera, Scene
from mrgs.scene.depth_map import DepthMap
from mrgs.system.atomic import replacing, write_text
from mrgs.system.lazy import optional_package
from mrgs.system.wording import number_text

MAX_PIXELS = 50_000_000
"""Largest number of pixels of a map; drawing takes about 60 bytes per pixel."""

PART_PX = 1024
"""Largest width and height, in pixels, of the parts that a map is drawn in."""

LEAST_ALPHA = 0.05
"""A colour that is blended less is darker than its surface."""

Appraise: TypeAlias = Callable[
    [Float32[np.ndarray, "n 3"], Float32[np.ndarray, " n"]],
    tuple[Float32[np.ndarray, " n"], Float32[np.ndarray, " n"]],
]
"""Corrects temperatures, °C, that the cameras of the photos see at points on surfaces, for marked
surfaces with an emissivity of their own; returns also their uncertainty, NaN where not known."""

BANDS = {
    "temperature_c": "°C",
    "red": "0 to 255",
    "green": "0 to 255",
    "blue": "0 to 255",
    "photos": "thermal photos that show the place",
    "scatter_c": "°C, standard deviation of the photos' readings",
    "uncertainty_c": "°C, half of the interval that holds the truth in 95 of 100 cases; without "
    "the thermal camera's own error where its accuracy is not known",
}
"""Names of the bands, and their units."""


@dataclass(frozen=True, eq=False)
class OrthographicMap:
    """A map: its pixels, its ``BANDS``, [7, H, W], and the points of the scene that it shows,
    [H, W, 3]; NaN where there is no surface, temperatures also where no photo looked, the scatter
    where fewer than two did."""

    grid: MapGrid
    bands: Float32[np.ndarray, "b h w"]
    points: Float32[np.ndarray, "h w 3"]

    @property
    def celsius(self) -> Float32[np.ndarray, "h w"]:
        """Temperatures, °C."""
        return self.bands[0]


def draw_map(
    baked: BakedModel,
    scene: Scene,
    maps: Sequence[DepthMap],
    grid: MapGrid,
    appraise: Appraise | None = None,
    coverage: Coverage | None = None,
) -> OrthographicMap:
    """Draw the splats without floaters, seen from very far away.

    The drawing gives the surface of each pixel and its colour. Its temperature is the mean of what
    the cameras of the photos see there in the model, as in all exports: from where no photo was
    taken, splats may leave gaps. ``maps`` are the model's ``survey``; without ``appraise``,
    temperatures are as the photos have them, without uncertainty; ``coverage`` leaves empty what
    too few photos show.

    ConfigError if the map has more than ``MAX_PIXELS``, RunError if no photo shows any of it."""
    if grid.width * grid.height > MAX_PIXELS:
        raise ConfigError(
            f"the map would have {grid.width}×{grid.height} pixels of {grid.pixel_m:g} m, more "
            f"than {MAX_PIXELS:,}; choose larger pixels",
            options=("pixel_size_m",),
        )
    means = to_array(baked.means)
    drawn = torch.from_numpy(
        grid.inside(means.astype(np.float64)) & surfaces.on_seen_surface(maps, means)
    )
    # All others become transparent: a copy of the splats to draw would take more memory.
    opacities = {each: opacity * drawn for each, opacity in baked.opacities.items()}
    splats = replace(baked, opacities=opacities)
    bands = np.full((len(BANDS), grid.height, grid.width), np.nan, np.float32)
    points = np.full((grid.height, grid.width, 3), np.nan, np.float32)
    shown = ShownPlaces(maps, grid)
    for top, left in product(range(0, grid.height, PART_PX), range(0, grid.width, PART_PX)):
        height, width = min(PART_PX, grid.height - top), min(PART_PX, grid.width - left)
        part = slice(top, top + height), slice(left, left + width)
        camera = grid.camera(left, top, width, height)
        bands[1:4, part[0], part[1]], points[part] = _draw_part(splats, scene, camera, part, shown)
    if coverage is not None:
        beyond = ~coverage.covers(*grid.middles)
        bands[:, beyond], points[beyond] = np.nan, np.nan
    statistics = PhotoStatistics(points, grid)
    for image in scene.train_photos(THERMAL):
        statistics.add(surfaces.photo_map(baked, scene, image))
    if not statistics.photos.any():
        raise RunError("no thermal photo shows a surface of this map: check its plane")
    bands[0], bands[5] = statistics.celsius, statistics.scatter_c
    bands[4] = np.where(np.isfinite(points[..., 0]), statistics.photos, np.nan)
    if appraise is not None:
        known = np.isfinite(bands[0])
        bands[0][known], bands[6][known] = appraise(points[known], bands[0][known])
    return OrthographicMap(grid, bands, points)


def _draw_part(
    splats: BakedModel, scene: Scene, camera: Camera, part: tuple[slice, slice], shown: ShownPlaces
) -> tuple[Float32[np.ndarray, "3 h w"], Float32[np.ndarray, "h w 3"]]:
    """Colours, 0 to 255, and points of the surface; NaN where there is none."""
    size = camera.height, camera.width
    colors, points = (np.full(shape, np.nan, np.float32) for shape in ((3, *size), (*size, 3)))
    # The mean would lose digits from as far away as a map's camera stands.
    depth = to_array(splats.median_depth(scene.modalities[0], camera))
    depth = shown.depth_of_part(part, camera, depth)
    surface = np.isfinite(depth)
    points[surface] = surfaces.unprojected(camera, depth)[surface]
    if RGB in scene.modalities:
        blend = splats.render({RGB: camera})[RGB]
        # The light that gets through gaps between splats is black: it is not a colour of a surface.
        opaque = blend.image / blend.alpha.clamp_min(LEAST_ALPHA)[..., None]
        colors[:, surface] = 255 * to_array(opaque).clip(0, 1)[surface].T
    return colors, points


SMALLEST_PX, LARGEST_PX = 900, 2400
"""Width or height, whichever is larger, that the map itself has in the picture."""

MARGIN = 36
BAR_SHARE = 0.25
"""Longest scale bar, as a share of the map's width."""


class Caption(NamedTuple):
    """The texts of a picture; ``north_deg`` is that of north, clockwise from up, if known."""

    title: str
    subtitle: str
    footer: str
    north_deg: float | None


def map_scale(
    drawn: OrthographicMap, palette: PaletteName, range_c: tuple[float, float] | None = None
) -> Scale:
    """The colours of a map's temperatures. ``range_c`` are the °C of the first and the last colour;
    None takes those of the map."""
    return Scale(palette, *(range_c or display_range(drawn.celsius)), "°C")


def map_picture(drawn: OrthographicMap, caption: Caption, scale: Scale) -> Image.Image:
    """The temperatures of a map as a picture, with its texts."""
    body, metres_per_px = map_body(drawn, scale)
    framed = frame_map(body, metres_per_px, scale, caption.north_deg)
    picture = blank((framed.width, framed.height + MARGIN + 102))
    text = picture.width - 2 * MARGIN
    draw_text(picture, (MARGIN, MARGIN + 26), fit_text(caption.title, 30, text), 30, bold=True)
    draw_text(picture, (MARGIN, MARGIN + 60), fit_text(caption.subtitle, 19, text), 19, MUTED)
    picture.paste(framed, (0, MARGIN + 64))
    footer = fit_text(caption.footer, 17, text)
    draw_text(picture, (MARGIN, picture.height - 18), footer, 17, MUTED)
    return picture


def map_body(drawn: OrthographicMap, scale: Scale) -> tuple[Image.Image, float]:
    """The temperatures of a map in colours, and the width of a pixel of the image, metres."""
    colors = scale.colorize(drawn.celsius)
    if scale.palette != "error":  # whose middle is as good as white
        colors[np.isnan(drawn.celsius)] = PAPER
    body, zoom = _fitted(Image.fromarray(colors))
    return body, drawn.grid.pixel_m / zoom


def frame_map(
    body: Image.Image, metres_per_px: float | None, scale: Scale, north_deg: float | None
) -> Image.Image:
    """A map's image with its legend, a scale bar, and an arrow to the north, which is ``north_deg``
    clockwise from up; without these if they are None."""
    legend = scale_bar(scale, min(body.height, 520), "vertical", size=20)
    width = max(body.width, 480) + legend.width + 3 * MARGIN
    picture = blank((width, body.height + 2 * MARGIN + 58))
    picture.paste(body, (MARGIN, MARGIN))
    picture.paste(legend, (width - MARGIN - legend.width, MARGIN))
    below = body.height + 2 * MARGIN
    if metres_per_px is not None:
        draw_length(picture, (MARGIN, below), body.width, metres_per_px, scale.decimal)
    if north_deg is not None:
        draw_north(picture, (MARGIN + body.width - 24, below + 10), north_deg)
    return picture


def _fitted(image: Image.Image) -> tuple[Image.Image, float]:
    """The image at a size for people, and its magnification."""
    longest = max(image.size)
    zoom = 1.0
    if longest < SMALLEST_PX:
        zoom = float(np.ceil(SMALLEST_PX / longest))
    elif longest > LARGEST_PX:
        zoom = LARGEST_PX / longest
    size = (max(1, round(image.width * zoom)), max(1, round(image.height * zoom)))
    how = Image.Resampling.NEAREST if zoom > 1 else Image.Resampling.BOX
    return image.resize(size, how), zoom


def draw_length(
    picture: Image.Image, position: tuple[int, int], width: int, metres_per_px: float, decimal: str
) -> None:
    """A bar of a round length in four fields, black and white in turn."""
    length, (zero, half, whole) = bar_length(width, metres_per_px, decimal)
    field = length / 4
    draw = ImageDraw.Draw(picture)
    left, top = position
    for k in range(4):
        box = (left + k * field, top, left + (k + 1) * field, top + 12)
        draw.rectangle(box, fill=INK if k % 2 == 0 else PAPER, outline=INK)
    draw_text(picture, (left, top + 34), zero, 18)
    for label, place in ((half, 2), (whole, 4)):
        draw_text(picture, (left + place * field, top + 34), label, 18, anchor="ms")


def bar_length(width: int, metres_per_px: float, decimal: str) -> tuple[float, list[str]]:
    """Length of the scale bar of a map, pixels, and the labels at its two ends and its middle."""
    longest = BAR_SHARE * width * metres_per_px
    power = 10.0 ** float(np.floor(np.log10(longest)))
    # 1, 2 and 4 halve well.
    metres = next(f * power for f in (4, 2, 1) if f * power <= longest * (1 + 1e-9))
    unit, factor = ("m", 1.0) if metres >= 0.5 else ("cm", 100.0) if metres >= 0.01 else ("mm", 1e3)
    zero, half, whole = tick_labels([0.0, factor * metres / 2, factor * metres], decimal)
    return metres / metres_per_px, [zero, half, f"{whole} {unit}"]


def draw_north(picture: Image.Image, middle: tuple[float, float], angle_deg: float) -> None:
    """An arrow at an angle clockwise from up, with an N at its tip."""
    ahead = np.exp(1j * np.radians(angle_deg - 90))

    def place(forward: float, right: float) -> tuple[float, float]:
        at = complex(*middle) + ahead * complex(forward, right)
        return at.real, at.imag

    tip, notch = place(20, 0), place(-11, 0)
    draw = ImageDraw.Draw(picture)
    draw.polygon([tip, place(-20, -13), notch], fill=INK)
    draw.polygon([tip, place(-20, 13), notch], fill=PAPER, outline=INK)
    x, y = place(32, 0)
    draw_text(picture, (x, y + 7), "N", 20, anchor="ms", bold=True)


CLOUD_OPTIMISED = {
    "driver": "COG", "compress": "deflate", "predictor": "yes", "blocksize": 256,
    "overview_resampling": "average", "bigtiff": "if_safer",
}  # fmt: skip
"""How GDAL writes a GeoTIFF of which programs on a network read the parts that they show."""


def require_rasterio() -> Any:
    """Import the package rasterio. ConfigError if it is not installed."""
    rasterio = optional_package("rasterio", "maps", "export")
    import_module("rasterio.shutil")
    return rasterio


def write_geotiff(
    path: Path,
    grid: MapGrid,
    bands: Float32[np.ndarray, "b h w"],
    units: Mapping[str, str],
    wkt: str,
    tags: Mapping[str, str],
) -> Path:
    """Write the bands of a map, their units by their names, in a coordinate system (WKT) with tags,
    as a cloud-optimised GeoTIFF without loss; returns the path. ConfigError if rasterio is not
    installed, RunError if the file cannot be written."""
    color = require_rasterio().enums.ColorInterp
    values = {"dtype": "float32", "nodata": float("nan"), "count": len(units)}
    with _copied(path, grid, wkt, values, CLOUD_OPTIMISED) as file:
        file.write(bands)
        file.update_tags(**tags)
        colors = {name: color[name] for name in ("red", "green", "blue")}
        file.colorinterp = [colors.get(name, color.undefined) for name in units]
        for number, (name, unit) in enumerate(units.items(), start=1):
            file.set_band_description(number, name)
            file.set_band_unit(number, unit)
    return path


def write_kmz(path: Path, pixels: UInt8[np.ndarray, "h w 4"], grid: MapGrid, wkt: str) -> Path:
    """Write the picture of a map (RGBA) in a coordinate system on Earth (WKT) as an overlay for
    Google Earth and others, in tiles; returns the path. Errors as for ``write_geotiff``."""
    overlay = {"driver": "KMLSUPEROVERLAY", "format": "PNG", "name": path.stem}
    with _copied(path, grid, wkt, {"dtype": "uint8", "count": 4}, overlay) as file:
        file.write(pixels.transpose(2, 0, 1))
    return path


@contextmanager
def _copied(
    path: Path, grid: MapGrid, wkt: str, values: Mapping[str, Any], made: Mapping[str, Any]
) -> Iterator[Any]:
    """Give a plain GeoTIFF of a map to write into, of which GDAL then makes the file with the
    options ``made``: it writes such formats as copies only. WriteError if that fails."""
    rasterio = require_rasterio()
    # Copies raise GDAL's own errors.
    failures = rasterio.errors.RasterioError, import_module("rasterio._err").CPLE_BaseError
    edges = rasterio.Affine(grid.pixel_m, 0.0, grid.left, 0.0, -grid.pixel_m, grid.top)
    profile = {
        "driver": "GTiff", "BIGTIFF": "IF_SAFER", "width": grid.width, "height": grid.height,
        "crs": rasterio.crs.CRS.from_wkt(wkt), "transform": edges,
    }  # fmt: skip
    with replacing(path) as temporary:
        plain = temporary.with_name("plain.tif")
        try:
            with rasterio.open(plain, "w", **profile, **values) as file:
                yield file
            rasterio.shutil.copy(plain, temporary, **made)
        except failures as error:
            raise OSError(0, f"GDAL: {error}") from error


STOPS = 16
"""Colours between which QGIS interpolates."""


def write_style(path: Path, scale: Scale) -> Path:
    """Write the style of a map's first band, which QGIS applies by its name: ``NAME.qml`` beside
    ``NAME.tif``; returns the path. RunError if the file cannot be written."""
    low, high = min(scale.low, scale.high), max(scale.low, scale.high)
    document = ElementTree.Element("qgis", styleCategories="Symbology")
    renderer = ElementTree.SubElement(
        ElementTree.SubElement(document, "pipe"),
        "rasterrenderer",
        type="singlebandpseudocolor", band="1", opacity="1", alphaBand="-1",
        classificationMin=f"{low:.4f}", classificationMax=f"{high:.4f}",
    )  # fmt: skip
    ramp = ElementTree.SubElement(
        ElementTree.SubElement(renderer, "rastershader"),
        "colorrampshader",
        colorRampType="INTERPOLATED", classificationMode="1", clip="0",
        minimumValue=f"{low:.4f}", maximumValue=f"{high:.4f}",
    )  # fmt: skip
    shares = np.linspace(0, 1, STOPS)
    values = scale.low + shares * (scale.high - scale.low)
    colors = palette_table(scale.palette)[np.rint(255 * shares).astype(int)]
    for value, color in sorted(zip(values.tolist(), colors.tolist(), strict=True)):
        ElementTree.SubElement(
            ramp,
            "item",
            value=f"{value:.4f}", label=f"{number_text(value, 1)} {scale.unit}", alpha="255",
            color="#" + bytes(color).hex(),
        )  # fmt: skip
    ElementTree.indent(document)
    return write_text(path, ElementTree.tostring(document, encoding="unicode") + "\n")
