"""A map as a picture for people: colours, legend in °C, scale bar, north arrow; and as a GeoTIFF
with a style for GIS."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float32
from PIL import Image, ImageDraw

from mrgs.maps.draw import OrthographicMap
from mrgs.maps.surfaces import MapGrid
from mrgs.pictures.drawing import INK, MUTED, PAPER, Scale, blank, draw_text, fit_text, scale_bar
from mrgs.pictures.numbers import number_text
from mrgs.pictures.palette import PaletteName, display_range, palette_table, tick_labels
from mrgs.system.atomic import replacing, write_text
from mrgs.system.lazy import optional_package

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
        _draw_length(picture, (MARGIN, below), body.width, metres_per_px, scale.decimal)
    if north_deg is not None:
        _draw_north(picture, (MARGIN + body.width - 24, below + 10), north_deg)
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


def _draw_length(
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


def _draw_north(picture: Image.Image, middle: tuple[float, float], angle_deg: float) -> None:
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


TILE_PX = 256

require_rasterio = partial(optional_package, "rasterio", "maps", "export")


def write_geotiff(
    path: Path,
    grid: MapGrid,
    bands: Float32[np.ndarray, "b h w"],
    units: Mapping[str, str],
    wkt: str,
    tags: Mapping[str, str],
) -> Path:
    """Write the bands of a map, their units by their names, in a coordinate system (WKT) with tags,
    tiled and compressed without loss; returns the path. ConfigError if rasterio is not installed,
    RunError if the file cannot be written."""
    rasterio = require_rasterio()
    profile = {
        "driver": "GTiff", "dtype": "float32", "nodata": float("nan"), "count": len(units),
        "width": grid.width, "height": grid.height,
        "crs": rasterio.crs.CRS.from_wkt(wkt),
        "transform": rasterio.Affine(grid.pixel_m, 0.0, grid.left, 0.0, -grid.pixel_m, grid.top),
        "tiled": True, "blockxsize": TILE_PX, "blockysize": TILE_PX,
        "compress": "deflate", "predictor": 3, "BIGTIFF": "IF_SAFER",
    }  # fmt: skip
    color = rasterio.enums.ColorInterp
    with replacing(path) as temporary:
        try:
            with rasterio.open(temporary, "w", **profile) as file:
                file.write(bands)
                file.update_tags(**tags)
                colors = {name: color[name] for name in ("red", "green", "blue")}
                file.colorinterp = [colors.get(name, color.undefined) for name in units]
                for number, (name, unit) in enumerate(units.items(), start=1):
                    file.set_band_description(number, name)
                    file.set_band_unit(number, unit)
        except rasterio.errors.RasterioError as error:
            raise OSError(0, f"GDAL: {error}") from error
    return path


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
