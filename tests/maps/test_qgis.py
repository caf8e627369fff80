"""QGIS's library reads the maps as they were written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
import rasterio

from mrgs.export import export
from mrgs.maps.draw import BANDS
from mrgs.maps.options import MapOptions
from mrgs.scene import WorldFrame
from tests.helpers.exports import qgis_python, read_ply, read_qgis

pytestmark = pytest.mark.skipif(
    qgis_python() is None,
    reason="QGIS's library is not installed: apt-get install python3-qgis",
)

OPTIONS = MapOptions(pixel_size_m=0.1)


def points_of(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Middles of pixels all over a map, and the bands there as rasterio reads them."""
    with rasterio.open(path) as file:
        rows, columns = np.mgrid[0 : file.height : 7, 0 : file.width : 9].reshape(2, -1)
        points = np.stack(rasterio.transform.xy(file.transform, rows, columns), axis=1)
        return points, file.read()[:, rows, columns].T


def check(raster: dict[str, Any], path: Path, values: np.ndarray) -> None:
    """That QGIS knows the bands, the place and the values of a map."""
    assert raster["valid"]
    assert [each.partition(": ")[2] for each in raster["bands"]] == list(BANDS)
    assert np.isnan(raster["nodata"]).all()
    assert raster["renderer"]["type"] == "singlebandpseudocolor"
    assert raster["renderer"]["bands"] == [1]
    with rasterio.open(path) as file:
        np.testing.assert_allclose(raster["extent"], file.bounds, atol=1e-6)
        assert raster["size"] == [file.width, file.height]
    np.testing.assert_array_equal(np.float32(raster["values"]), values)
    assert np.isnan(values).any()
    assert np.isfinite(values).all(axis=1).any()


def test_maps_with_a_place_on_earth(tmp_path, front, front_scene):
    written = ["ortho", "las", "points"]
    export(front, front_scene, written, tmp_path, "black-hot", (-5.0, 20.0), OPTIONS)
    points, values = points_of(tmp_path / "ortho.tif")
    las = laspy.read(tmp_path / "points.las").header.vlrs.get("WktCoordinateSystemVlr")[0].string
    comments, _ = read_ply(tmp_path / "points.ply")
    (ply,) = (line for line in comments if line.startswith("crs: "))
    code = ply.removeprefix("crs: ").split(",")[0]
    answer = read_qgis(tmp_path, {tmp_path / "ortho.tif": points.tolist()}, [las, code])
    (raster,) = answer["rasters"]
    check(raster, tmp_path / "ortho.tif", values)
    colors = raster["renderer"]["colors"]
    assert colors[0] == [-5.0, "#ffffff", "−5.0 °C"]  # as the palette begins
    assert colors[-1] == [20.0, "#000000", "20.0 °C"]
    assert [each[0] for each in colors] == sorted(each[0] for each in colors)
    for crs in (raster["crs"], *answer["crs"]):
        assert (crs["valid"], crs["code"], crs["unit"]) == (True, "EPSG:32632", "meters")


def test_maps_in_metres_of_their_own(tmp_path, front, front_scene):
    """Of a façade, and from above without GPS."""
    local = replace(front_scene, world=WorldFrame(metric=True), name="Haus „Mühle“")
    export(front, local, ["ortho", "elevation"], tmp_path, maps=OPTIONS)
    written = {tmp_path / f"{name}.tif": points_of(tmp_path / f"{name}.tif") for name in names()}
    answer = read_qgis(tmp_path, {path: each[0].tolist() for path, each in written.items()})
    for raster, (path, (_, values)) in zip(answer["rasters"], written.items(), strict=True):
        check(raster, path, values)
        crs = raster["crs"]
        assert (crs["valid"], crs["code"], crs["geographic"]) == (True, "", False)
        assert crs["unit"] == "meters"
        assert "Haus Muhle" in crs["wkt"]


def names() -> tuple[str, str]:
    return "ortho", "elevation"
