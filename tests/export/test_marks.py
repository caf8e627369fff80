"""Marks and maps for GIS and CAD, read back by other programs' readers."""

from __future__ import annotations

import json
import shutil
import sqlite3
import zipfile
from dataclasses import replace
from xml.etree import ElementTree

import ezdxf
import numpy as np
import pyogrio
import pyproj
import pytest
import shapely
from PIL import Image

from mrgs.errors import ConfigError, RunError
from mrgs.export import export
from mrgs.export.marks import write_dxf, write_geopackage, write_kml
from mrgs.maps.crs import LOCAL, coordinate_system, local_wkt
from mrgs.maps.draw import write_kmz
from mrgs.maps.surfaces import MapGrid
from mrgs.marks import open_marks
from mrgs.marks.mark import Mark
from mrgs.runs.open import load_run
from mrgs.scene import THERMAL, EarthPosition, WorldFrame

MUNICH = WorldFrame(True, True, EarthPosition(48.137, 11.575, 520.0), 0.8)
CORNERS = ((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (2.0, 0.0, 1.5), (0.0, 0.0, 1.5))
EYE = (0.0, -8.0, 1.5)
MARKS = (
    Mark("S1", "spot", ((1.0, -2.0, 3.0),), EYE, radius=0.05),
    Mark("L1", "line", ((0.0, 0.0, 0.0), (4.0, 0.0, 3.0)), EYE),
    Mark("B1", "box", CORNERS, EYE),
    Mark("P1", "polygon", CORNERS[:3], EYE),
)
FOUND = [
    ({"name": mark.name, "mean_c": mean, "photos": photos, "note": note}, f"{mark.name} x", mark)
    for mark, mean, photos, note in zip(
        MARKS, (21.5, -3.25, None, 8.0), (4, 5, None, 2), ("", "Fenster, außen", "", ""),
        strict=True,
    )
]  # fmt: skip


@pytest.fixture(scope="module")
def munich(scene):
    return coordinate_system(replace(scene, world=MUNICH))


def test_a_geopackage_has_the_marks_by_kind_in_the_crs(munich, tmp_path):
    path = write_geopackage(tmp_path / "marks.gpkg", FOUND, munich)
    with sqlite3.connect(path) as file:
        layers = dict(file.execute("select table_name, srs_id from gpkg_contents"))
        assert layers == {"spots": 32632, "lines": 32632, "areas": 32632}
        assert file.execute("select name, mean_c, photos from spots").fetchall() == [
            ("S1", 21.5, 4)
        ]
        assert file.execute("select note from lines").fetchall() == [("Fenster, außen",)]
        assert file.execute("select name, mean_c, photos from areas").fetchall() == [
            ("B1", None, None),
            ("P1", 8.0, 2.0),
        ]
    _, _, (line,), _ = pyogrio.raw.read(path, layer="lines")
    places = shapely.get_coordinates(shapely.from_wkb(line), include_z=True)
    np.testing.assert_allclose(places, munich.apply(np.array(MARKS[1].points)), atol=1e-6)
    _, _, areas, _ = pyogrio.raw.read(path, layer="areas")
    assert shapely.get_coordinates(shapely.from_wkb(areas[0])).shape == (5, 2)  # closed


def test_a_geopackage_of_a_scene_without_a_place_has_its_own_coordinates(tmp_path):
    local = replace(LOCAL, wkt=local_wkt("hall"))
    path = write_geopackage(tmp_path / "marks.gpkg", FOUND, local)
    meta, _, (spot,), _ = pyogrio.raw.read(path, layer="spots")
    assert "hall" in meta["crs"]
    assert shapely.get_coordinates(shapely.from_wkb(spot), include_z=True).tolist() == [[1, -2, 3]]


def test_kml_lies_where_the_scene_does(munich, tmp_path):
    path = write_kml(tmp_path / "marks.kml", FOUND, munich)
    space = {"k": "http://www.opengis.net/kml/2.2"}
    placemarks = ElementTree.parse(path).findall(".//k:Placemark", space)
    assert [each.findtext("k:name", namespaces=space) for each in placemarks] == [
        mark.name for mark in MARKS
    ]
    data = {each.get("name"): each.text for each in placemarks[0].findall(".//k:SimpleData", space)}
    assert float(data["mean_c"]) == 21.5
    spot = placemarks[0].findtext("k:Point/k:coordinates", namespaces=space)
    longitude, latitude, _ = map(float, spot.split(","))
    azimuth, _, distance = pyproj.Geod(ellps="WGS84").inv(11.575, 48.137, longitude, latitude)
    assert distance == pytest.approx(np.hypot(1, 2), abs=2e-3)
    assert azimuth == pytest.approx(np.degrees(np.arctan2(1, -2)), abs=0.1)


def test_a_drawing_has_layers_names_and_metres(tmp_path):
    path = write_dxf(tmp_path / "marks.dxf", FOUND, LOCAL.apply)
    info = pyogrio.raw.read(path)
    layers, texts = (info[3][list(info[0]["fields"]).index(name)] for name in ("Layer", "Text"))
    assert set(layers) == {"spots", "lines", "areas"}
    assert {text for text in texts if text} == {f"{mark.name} x" for mark in MARKS}
    places = shapely.get_coordinates(
        shapely.from_wkb(info[2][layers == "lines"][0]), include_z=True
    )
    np.testing.assert_allclose(places, MARKS[1].points)
    assert ezdxf.readfile(path).header["$INSUNITS"] == 6  # metres


def test_a_drawing_has_the_picture_of_its_map_true_to_scale(tmp_path):
    grid = MapGrid(np.eye(3), 1.0, np.zeros(2), -1.0, 4.0, 0.05, 120, 80, (-1.0, 1.0))
    path = write_dxf(tmp_path / "ortho.dxf", FOUND[:1], LOCAL.apply, ("ortho_map.png", grid))
    (image,) = ezdxf.readfile(path).modelspace().query("IMAGE")
    assert image.image_def.dxf.filename == "ortho_map.png"
    np.testing.assert_allclose(image.dxf.insert, (-1, 0, 0), atol=1e-9)
    wide, high = np.array(image.dxf.u_pixel) * 120, np.array(image.dxf.v_pixel) * 80
    np.testing.assert_allclose((wide, high), ((6, 0, 0), (0, 4, 0)), atol=1e-9)


def test_a_globe_has_the_map_where_it_lies(munich, tmp_path):
    left, top, _ = munich.apply(np.array([[-3.0, 2.0, 0.0]]))[0]
    grid = MapGrid(np.eye(3), 1.0, np.zeros(2), left, top, 0.05, 120, 80, (-1.0, 1.0))
    pixels = np.full((80, 120, 4), 255, np.uint8)
    pixels[:40, :60, :3] = 0  # the north-west
    path = write_kmz(tmp_path / "ortho.kmz", pixels, grid, munich.wkt)
    with zipfile.ZipFile(path) as file:
        text = "".join(file.read(name).decode() for name in file.namelist() if ".kml" in name)
        pictures = [name for name in file.namelist() if name.endswith(".png")]
        tile = np.asarray(Image.open(file.open(max(pictures, key=len))).convert("RGBA"))
    boxes = {
        side: [float(each.split("<")[0]) for each in text.split(f"<{side}>")[1:]]
        for side in ("north", "south", "east", "west")
    }
    assert "<name>ORTHO</name>" in text  # rasterio writes options in capitals
    assert min(boxes["south"]) < 48.137 < max(boxes["north"])
    assert min(boxes["west"]) < 11.575 < max(boxes["east"])
    assert max(boxes["north"]) - min(boxes["south"]) == pytest.approx(4 / 111_200, rel=0.1)
    degrees = 6 / (111_320 * np.cos(np.radians(48.137)))
    assert max(boxes["east"]) - min(boxes["west"]) == pytest.approx(degrees, rel=0.1)
    rows, columns = np.nonzero((tile[..., 3] > 0) & (tile[..., 0] == 0))
    drawn = np.argwhere(tile[..., 3] > 0)
    assert rows.mean() < drawn[:, 0].mean()
    assert columns.mean() < drawn[:, 1].mean()


@pytest.fixture(scope="module")
def marked(run, scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("marked") / "run"
    shutil.copytree(run.folder.path, folder)
    marks = open_marks(load_run(folder), scene)
    camera = scene.train_photos(THERMAL)[0].camera
    marks.spot(camera, (camera.width / 2, camera.height / 2))
    return marks.run


def test_the_marks_of_a_run_are_exported_with_their_readings(marked, scene, tmp_path):
    """All files have the same mean; KML only where the scene has a place on Earth."""
    metric = replace(scene, world=WorldFrame(metric=True))
    export(marked, metric, "marks", tmp_path / "here")
    names = sorted(path.name for path in (tmp_path / "here").iterdir())
    assert names == ["marks.dxf", "marks.geojson", "marks.gpkg"]
    features = json.loads((tmp_path / "here" / "marks.geojson").read_text(encoding="utf-8"))
    (facts,) = (each["properties"] for each in features["features"])
    with sqlite3.connect(tmp_path / "here" / "marks.gpkg") as file:
        found = file.execute("select name, mean_c, uncertainty_c from spots").fetchall()
    assert found == [("S1", facts["mean_c"], facts["uncertainty_c"])]
    text = ezdxf.readfile(tmp_path / "here" / "marks.dxf").modelspace().query("TEXT")[0].dxf.text
    assert text == f"S1 {facts['mean_c']:.1f} °C".replace("-", "−")
    export(marked, replace(scene, world=MUNICH), "marks", tmp_path / "earth")
    assert (tmp_path / "earth" / "marks.kml").exists()


def test_without_marks_or_metres_there_is_nothing_to_export(run, scene, tmp_path):
    with pytest.raises(ConfigError, match="no marks to export"):
        export(run, replace(scene, world=WorldFrame(metric=True)), "marks", tmp_path)
    with pytest.raises(ConfigError, match="no scale"):
        export(run, replace(scene, world=WorldFrame()), "marks", tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_file_that_cannot_be_written_is_named(munich, tmp_path):
    (tmp_path / "marks.gpkg").mkdir()
    with pytest.raises(RunError, match=r"marks\.gpkg cannot be written"):
        write_geopackage(tmp_path / "marks.gpkg", FOUND, munich)
