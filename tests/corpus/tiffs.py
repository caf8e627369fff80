"""TIFF files as programs other than cameras write them."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

ORIENTATION, METADATA, NODATA = 274, 42112, 42113


def write_tiff(path: Path, pixels: np.ndarray, **tags: Any) -> Path:
    """A TIFF of pixels as they are stored, with the tags ``t274`` and so on."""
    path.parent.mkdir(parents=True, exist_ok=True)
    directory = ImageFileDirectory_v2()
    for name, value in tags.items():
        directory[int(name[1:])] = value
    Image.fromarray(pixels).save(path, "TIFF", tiffinfo=directory)
    return path


def scaled_by_gdal(scale: float, offset: float) -> str:
    """The tag in which GDAL writes the scale and the offset of a band."""
    return (
        "<GDALMetadata>\n"
        f'  <Item name="OFFSET" sample="0" role="offset">{offset}</Item>\n'
        f'  <Item name="SCALE" sample="0" role="scale">{scale}</Item>\n'
        "</GDALMetadata>"
    )


def write_by_gdal(path: Path, pixels: np.ndarray, unit: str = "", **options: Any) -> Path:
    """A TIFF of one or more bands, [H, W] or [B, H, W], by GDAL itself."""
    import rasterio

    bands = pixels if pixels.ndim == 3 else pixels[None]
    count, height, width = bands.shape
    shape = {"count": count, "height": height, "width": width, "dtype": pixels.dtype}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a file without a place on Earth
        with rasterio.open(path, "w", driver="GTiff", **shape, **options) as dataset:
            dataset.write(bands)
            if unit:
                dataset.units = (unit,) * count
    return path
