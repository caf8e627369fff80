from __future__ import annotations

import json
import re
import sys
from dataclasses import replace

import laspy
import numpy as np
import pyproj
import pytest
import rasterio
import rasterio.warp
import torch
from PIL import Image

from mrgs.errors import ConfigError, RunError, WriteError
from mrgs.export import export
from mrgs.export.maps import ortho_texts
from mrgs.maps.crs import LOCAL_NAME, coordinate_system
from mrgs.maps.draw import OrthographicMap
from mrgs.maps.options import MapOptions, parse_plane
from mrgs.maps.surfaces import MapGrid, pixel_size_m, seen_surfaces
from mrgs.scene import RGB, THERMAL, EarthPosition, View, WorldFrame
from tests.helpers.exports import read_ply
from tests.maps.conftest import CELSIUS, GROUND_C, PIXEL, WALL_C, WINDOW_C, WINDOWS

OPTIONS = MapOptions(pixel_size_m=PIXEL)
PLANE = ((-3.0, 0.0, 0.0), (3.0, 0.0, 0.3), (0.0, 0.0, 4.0))
"""Not level: where the vertical is known, the map is upright all the same."""


@pytest.fixture(scope="module")
def elevation(tmp_path_factory, front, front_scene):
    folder = tmp_path_factory.mktemp("elevation")
    export(front, front_scene, "elevation", folder, maps=OPTIONS)
    return folder


@pytest.fixture(scope="module")
def ortho(tmp_path_factory, front, front_scene):
    folder = tmp_path_factory.mktemp("ortho")
    export(front, front_scene, "ortho", folder, maps=OPTIONS)
    return folder


def edges(row: np.ndarray) -> np.ndarray:
    """Where a row of a map crosses the mean of wall and window, pixels from its beginning."""
    above = row - (WALL_C + WINDOW_C) / 2
    first = np.flatnonzero(above[:-1] * above[1:] < 0)
    return first + 0.5 + above[first] / (above[first] - above[first + 1])


def test_the_facade_is_found_and_metric(elevation):
    with rasterio.open(elevation / "elevation.tif") as file:
        celsius = file.read(1)
        assert (file.count, file.dtypes[0]) == (7, "float32")
        assert 'UNIT["metre",1' in file.crs.to_wkt()
        assert np.isnan(file.nodata)
        assert file.res == (PIXEL, PIXEL)
        assert (file.bounds.left, file.bounds.bottom) == (0, 0)
    facts = json.loads((elevation / "elevation.tif.json").read_text(encoding="utf-8"))
    assert float(facts["faces_azimuth_deg"]) == pytest.approx(180, abs=1)
    corner = np.array(facts["map_corner_in_scene"])
    np.testing.assert_allclose(facts["map_right_in_scene"], [1, 0, 0], atol=0.01)
    np.testing.assert_allclose(facts["map_up_in_scene"], [0, 0, 1], atol=1e-6)
    assert abs(corner[1]) < 0.05  # on the wall
    row = len(celsius) - round((2.0 - corner[2]) / PIXEL)  # 2 m up, through both windows
    found = corner[0] + PIXEL * edges(celsius[row])
    known = np.array([edge for window in WINDOWS for edge in window[:2]])
    a_photo_s_pixel = 0.065
    np.testing.assert_allclose(found, known, atol=a_photo_s_pixel)
    # Opaque discs that overlap in one plane show their nearer halves: an untrained wall looks half
    # a disc wider on both sides.
    np.testing.assert_allclose(found[2:] - found[:2], known[2:] - known[:2], atol=a_photo_s_pixel)
    column = round((-2.0 - corner[0]) / PIXEL)
    heights = corner[2] + PIXEL * (len(celsius) - edges(celsius[:, column]))
    np.testing.assert_allclose(heights[:2], [3, 1], atol=a_photo_s_pixel)


def test_temperatures_are_those_of_the_rendered_model(elevation, front, front_scene):
    """Seen from a camera that was not used, everywhere but on edges between temperatures."""
    with rasterio.open(elevation / "elevation.tif") as file:
        celsius = file.read(1)
    facts = json.loads((elevation / "elevation.tif.json").read_text(encoding="utf-8"))
    corner, size = np.array(facts["map_corner_in_scene"]), celsius.shape
    rows, columns = np.nonzero(np.isfinite(celsius))
    u, v = (columns + 0.5) * PIXEL, (size[0] - rows - 0.5) * PIXEL
    points = (
        corner + np.outer(u, facts["map_right_in_scene"]) + np.outer(v, facts["map_up_in_scene"])
    )
    camera = front_scene.train[3].camera.look_at((0.7, -6.0, 2.4), (0.2, 0.0, 2.5))
    rendered = CELSIUS.to_celsius(front.render(camera)[THERMAL].image[..., 0]).numpy()
    pixels, _ = camera.project(torch.from_numpy(points))
    flat = np.ones(len(points), bool)
    for edge in (*(each for window in WINDOWS for each in window[:2]), -4, 4):
        flat &= np.abs(points[:, 0] - edge) > 0.25
    for edge in (0, 1, 3, 5):
        flat &= np.abs(points[:, 2] - edge) > 0.25
    flat &= camera.contains(pixels).numpy()
    assert flat.sum() > 2000
    x, y = pixels[flat].long().T.numpy()
    difference = celsius[rows[flat], columns[flat]] - rendered[y, x]
    assert np.abs(difference).max() < 0.1


def test_bands_say_how_many_photos_looked_and_how_far_they_scatter(elevation):
    with rasterio.open(elevation / "elevation.tif") as file:
        celsius, red, _, blue, photos, scatter, uncertainty = file.read()
        assert file.descriptions == (
            "temperature_c", "red", "green", "blue", "photos", "scatter_c",
            "uncertainty_c",
        )  # fmt: skip
        assert file.units[0] == "°C"
        assert file.colorinterp[1] == rasterio.enums.ColorInterp.red
    known = np.isfinite(celsius)
    assert np.nanmedian(celsius) == pytest.approx(WALL_C, abs=0.1)
    assert set(np.unique(photos[known])) <= {1, 2, 3, 4, 5, 6, 7}
    assert np.nanmedian(photos) >= 5
    assert np.nanmedian(scatter[photos >= 5]) == pytest.approx(0.1, abs=0.03)  # the photos' noise
    assert np.isnan(scatter[photos < 2]).all()
    assert 0.05 < np.nanmedian(uncertainty[photos >= 5]) < 0.5
    assert np.isnan(uncertainty[np.isnan(celsius)]).all()
    assert np.isnan(celsius[np.isnan(photos) | (photos == 0)]).all()
    wall = known & (np.abs(celsius - WALL_C) < 0.3)
    assert np.nanmedian(red[wall]) == pytest.approx(0.8 * 255, abs=8)
    assert np.nanmedian(blue[wall]) == pytest.approx(0.2 * 255, abs=8)


def test_three_points_give_the_same_facade(tmp_path, elevation, front, front_scene):
    options = replace(OPTIONS, plane=PLANE)
    export(front, front_scene, "elevation", tmp_path, maps=options)
    images = []
    for folder in (tmp_path, elevation):
        with rasterio.open(folder / "elevation.tif") as file:
            images.append(file.read(1))
    assert np.abs(np.subtract(images[0].shape, images[1].shape)).max() <= 2
    assert np.nanmax(images[0]) == pytest.approx(WINDOW_C, abs=0.5)


def test_from_above_the_map_lies_in_utm(ortho, front_scene):
    with rasterio.open(ortho / "ortho.tif") as file:
        celsius = file.read(1)
        assert file.crs.to_epsg() == 32632
        assert file.bounds.left / PIXEL == pytest.approx(round(file.bounds.left / PIXEL), abs=1e-3)
        x, y = rasterio.warp.transform("EPSG:4326", file.crs, [11.575], [48.137])
        row, column = file.index(x[0], y[0])
        transform = file.transform
    # The origin of the scene is the foot of the wall in its middle; before it (south) is ground.
    assert np.nanmedian(celsius[row + 10 : row + 40, column - 30 : column + 30]) == pytest.approx(
        GROUND_C, abs=0.1
    )
    assert celsius[row, column] == pytest.approx(WALL_C, abs=0.1)
    assert np.isnan(celsius[: row - 2, column]).all()  # behind the wall nothing was seen
    # A point 4 m to the south lies where PROJ's own arithmetic says.
    local = pyproj.Proj("+proj=tmerc +lat_0=48.137 +lon_0=11.575 +k=1 +ellps=WGS84")
    longitude, latitude = local(3.0, -4.0, inverse=True)
    east, north = rasterio.warp.transform("EPSG:4326", "EPSG:32632", [longitude], [latitude])
    facts = json.loads((ortho / "ortho.tif.json").read_text(encoding="utf-8"))
    matrix = np.array(facts["crs_from_scene"])
    np.testing.assert_allclose((matrix @ [3, -4, 0, 1])[:2], [east[0], north[0]], atol=1e-3)
    assert facts["crs"].startswith("EPSG:32632")
    assert facts["map_crs_residual_m"] < 1e-3
    assert facts["gps_residual_m"] == 0.8
    assert abs(facts["map_north_clockwise_from_up_deg"]) < 5
    assert transform.a == PIXEL


def test_the_picture_has_legend_scale_and_north(ortho, elevation):
    for path in (ortho / "ortho.png", elevation / "elevation.png"):
        with Image.open(path) as picture:
            pixels = np.asarray(picture.convert("RGB")).astype(int)
        assert min(pixels.shape[:2]) > 400
        legend = pixels[140:400, -150:]
        assert (np.ptp(legend, axis=2) > 60).sum() > 1000
        bar = pixels[-140:, 36:300]
        assert (bar.sum(axis=2) < 120).sum() > 300


def test_las_and_ply_carry_the_same_crs(tmp_path, ortho, front, few_photos):
    export(front, few_photos, ["las", "points"], tmp_path)
    las = laspy.read(tmp_path / "points.las")
    crs = las.header.parse_crs()
    assert crs.to_epsg() == 32632 or "UTM zone 32N" in crs.name
    assert las.header.global_encoding.wkt
    comments, elements = read_ply(tmp_path / "points.ply")
    text = dict(line.split(": ", 1) for line in comments if ": " in line)
    assert text["crs"].startswith("EPSG:32632")
    vertex = elements["vertex"]
    positions = np.stack([vertex[axis].astype(float) for axis in "xyz"] + [np.ones(len(vertex))])
    moved = np.array(json.loads(text["crs_from_scene"])) @ positions
    np.testing.assert_allclose(las.xyz, moved[:3].T, atol=2e-3)
    assert las.xyz[:, 2].min() > 519  # metres above sea level


def test_without_gps_coordinates_are_the_scene_s(tmp_path, front, few_photos):
    local = replace(few_photos, world=WorldFrame(metric=True))
    export(front, local, ["ortho", "las"], tmp_path, maps=OPTIONS)
    with rasterio.open(tmp_path / "ortho.tif") as file:
        assert 'UNIT["metre",1' in file.crs.to_wkt()
        assert not file.crs.is_projected
        assert not file.crs.is_geographic
        assert file.bounds.left < -4 < 4 < file.bounds.right
        assert file.tags()["map_crs"] == LOCAL_NAME
    las = laspy.read(tmp_path / "points.las")
    assert abs(las.xyz[:, 0].mean()) < 1
    assert las.header.vlrs.get("WktCoordinateSystemVlr")[0].string.startswith("LOCAL_CS")


@pytest.mark.parametrize(
    ("changes", "options", "message"),
    [
        ({"world": WorldFrame()}, {}, "no scale"),
        ({"temperature": None}, {}, "no temperatures"),
        ({"world": WorldFrame(metric=True)}, {"crs": "EPSG:25832"}, "not georeferenced"),
        ({}, {"crs": "EPSG:99999"}, "unknown"),
        ({}, {"crs": "EPSG:4326"}, "projected"),
        ({}, {"crs": "EPSG:2263"}, "projected"),
        ({}, {"crs": "EPSG:32756"}, "48.1370°, 11.5750°"),
        ({}, {"pixel_size_m": 1e-5}, r"\d+×\d+ pixels"),
        ({"world": WorldFrame(True, True, EarthPosition(-88.0, 0.0, None))}, {}, "84°"),
    ],
)
def test_what_does_not_fit_is_said_in_one_line(
    tmp_path, front, front_scene, changes, options, message
):
    with pytest.raises(ConfigError, match=message) as caught:
        export(
            front,
            replace(front_scene, **changes),
            "ortho",
            tmp_path,
            maps=MapOptions(**{"pixel_size_m": 0.1, **options}),
        )
    assert "\n" not in str(caught.value)
    assert all(f"{value}" in str(caught.value) for value in options.values())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("format", ["ortho", "las", "ply", "all"])
def test_a_crs_that_does_not_fit_is_said_before_anything_is_baked(
    tmp_path, front, front_scene, format
):
    begun = []
    with pytest.raises(ConfigError, match="EPSG:32756"):
        export(
            front,
            front_scene,
            format,
            tmp_path,
            maps=MapOptions(crs="EPSG:32756"),
            progress=lambda number, count, name: begun.append(name),
        )
    assert not begun


def test_a_wanted_crs_is_used(tmp_path, front, few_photos):
    export(
        front,
        few_photos,
        "ortho",
        tmp_path,
        maps=MapOptions(pixel_size_m=0.5, crs="EPSG:25832"),
    )
    with rasterio.open(tmp_path / "ortho.tif") as file:
        assert file.crs.to_epsg() == 25832


def test_maps_and_points_are_in_the_local_frame_of_a_survey(tmp_path, front, few_photos):
    corners = []
    for offset in (None, (5000.0, 300.0, 100.0)):
        scene = replace(few_photos, world=WorldFrame(metric=True, north=True, offset=offset))
        export(front, scene, ["las", "ortho"], tmp_path, maps=MapOptions(pixel_size_m=0.5))
        with rasterio.open(tmp_path / "ortho.tif") as file:
            bounds = file.bounds[:2]
        las = laspy.read(tmp_path / "points.las")
        corners.append([las.x.min(), las.y.min(), las.z.min(), *bounds])
    moved = np.subtract(*corners[::-1])
    assert moved[:3] == pytest.approx([5000, 300, 100], abs=1e-4)
    assert moved[3:] == pytest.approx([5000, 300], abs=0.5)  # whole pixels


@pytest.mark.parametrize(
    ("crs", "place", "north_deg"),
    [
        (None, (48.137, 11.575), -2),
        ("EPSG:2048", (-33.9, 18.4), 180),
        ("EPSG:3413", (70.0, 20.0), -65),
    ],
)
def test_north_is_said_to_be_up_only_where_it_is(front_scene, crs, place, north_deg):
    placed = replace(front_scene, world=WorldFrame(True, True, EarthPosition(*place, 0.0)))
    grid = MapGrid(np.eye(3), 1.0, np.zeros(2), 0.0, 2.0, 0.05, 60, 40, (-1.0, 1.0))
    drawn = OrthographicMap(
        grid, np.ones((7, 40, 60), np.float32), np.zeros((40, 60, 3), np.float32)
    )
    caption, facts = ortho_texts("front", drawn, coordinate_system(placed, crs))
    assert abs((caption.north_deg - north_deg + 180) % 360 - 180) < 1
    assert ("north is up" in caption.subtitle) == (crs is None)
    assert facts["map_north_clockwise_from_up_deg"] == pytest.approx(caption.north_deg, abs=1e-3)


def test_all_files_of_an_export_name_the_wanted_crs(tmp_path, front, few_photos):
    options = MapOptions(pixel_size_m=0.5, crs="EPSG:3035")
    export(front, few_photos, ["las", "points", "ortho"], tmp_path, maps=options)
    sidecars = [json.loads(file.read_text(encoding="utf-8")) for file in tmp_path.glob("*.json")]
    assert len(sidecars) == 3
    assert all(facts["crs"].startswith("EPSG:3035") for facts in sidecars)
    (matrix,) = {json.dumps(facts["crs_from_scene"]) for facts in sidecars}
    _, elements = read_ply(tmp_path / "points.ply")
    vertex = elements["vertex"]
    positions = np.stack([vertex[axis].astype(float) for axis in "xyz"] + [np.ones(len(vertex))])
    moved = np.array(json.loads(matrix)) @ positions
    las = laspy.read(tmp_path / "points.las")
    np.testing.assert_allclose(las.xyz, moved[:3].T, atol=2e-3)


@pytest.mark.slow
def test_beyond_utm_maps_lie_in_a_polar_crs_or_in_none(tmp_path, front, few_photos):
    world = WorldFrame(True, True, EarthPosition(86.0, 20.0, 0.0))
    arctic, options = replace(few_photos, world=world), MapOptions(pixel_size_m=0.5)
    export(front, arctic, "elevation", tmp_path, maps=options)
    begun = []
    with pytest.raises(ConfigError, match="EPSG:3413"):
        export(front, arctic, "las", tmp_path, progress=lambda *part: begun.append(part))
    assert not begun
    export(front, arctic, "ortho", tmp_path, maps=replace(options, crs="EPSG:3413"))
    with rasterio.open(tmp_path / "ortho.tif") as file:
        assert file.crs.to_epsg() == 3413
        x, y = rasterio.warp.transform("EPSG:4326", file.crs, [20.0], [86.0])
        assert file.bounds.left < x[0] < file.bounds.right
        assert file.bounds.bottom < y[0] < file.bounds.top


def test_a_scene_without_a_wall_has_no_elevation(tmp_path, front, front_scene):
    ground = front.subset(torch.nonzero(front.means[:, 2] < 0.05)[:, 0])
    with pytest.raises(RunError, match="no façade"):
        export(ground, front_scene, "elevation", tmp_path, maps=OPTIONS)


def test_a_plane_off_all_surfaces_is_refused(tmp_path, front, front_scene):
    away = tuple((x, y - 40.0, z) for x, y, z in PLANE)
    with pytest.raises(RunError, match="on the plane"):
        export(front, front_scene, "elevation", tmp_path, maps=replace(OPTIONS, plane=away))


def test_a_scene_whose_vertical_is_not_known_is_refused(tmp_path, front, front_scene):
    views = tuple(
        View(view.name, {m: replace(i, camera=rolled(i.camera, k)) for m, i in view.images.items()})
        for k, view in enumerate(front_scene.train)
    )
    scene = replace(front_scene, train=views, world=WorldFrame(metric=True))
    with pytest.raises(ConfigError, match="way is up"):
        export(front, scene, "ortho", tmp_path, maps=OPTIONS)


def rolled(camera, k):
    """The camera turned about its axis."""
    angle = torch.tensor(0.9 * k, dtype=torch.float64)
    turn = torch.eye(4, dtype=torch.float64)
    turn[0, 0] = turn[1, 1] = angle.cos()
    turn[0, 1], turn[1, 0] = -angle.sin(), angle.sin()
    return type(camera)(camera.K, turn @ camera.viewmat, camera.width, camera.height)


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (("1,2", "0,0,0", "1,1,1"), "'1,2'.*X,Y,Z"),
        (("a,b,c", "0,0,0", "1,1,1"), "'a,b,c'"),
        (("nan,0,0", "0,0,0", "1,1,1"), "'nan,0,0'"),
        (("0,0,0", "1,1,1", "2,2,2"), "on a line"),
    ],
)
def test_points_that_span_no_plane_are_refused(texts, message):
    with pytest.raises(ConfigError, match=message):
        MapOptions(plane=parse_plane(*texts))


def test_a_map_for_a_page_has_no_more_pixels_than_are_asked_for(front, front_scene):
    maps, extent = seen_surfaces(front, front_scene), np.array([8.0, 5.0])

    def pixel(options: MapOptions, most_px: int | None) -> float:
        return pixel_size_m(front_scene, maps, options, extent, most_px)

    of_photos = pixel(MapOptions(), None)
    assert 0.01 < of_photos < 0.05
    assert pixel(MapOptions(), 10_000) == of_photos
    assert pixel(MapOptions(), 100) == 0.08
    assert pixel(MapOptions(pixel_size_m=0.5), 100) == 0.5


def test_a_pixel_size_is_above_zero():
    with pytest.raises(ConfigError, match="of 0 m"):
        MapOptions(pixel_size_m=0.0)


@pytest.mark.parametrize("package", ["rasterio", "pyproj"])
def test_without_the_extra_it_is_named(tmp_path, front, front_scene, monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ConfigError, match=re.escape("mrgs[export]")) as caught:
        export(front, front_scene, "ortho", tmp_path)
    assert package in str(caught.value)


def test_a_folder_that_cannot_be_written_is_said(tmp_path, front, few_photos):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(WriteError, match="out"):
        export(front, few_photos, "ortho", tmp_path / "out", maps=MapOptions(pixel_size_m=0.3))


def test_what_floats_behind_the_cameras_is_not_drawn(ortho):
    with rasterio.open(ortho / "ortho.tif") as file:
        assert np.nanmax(file.read(1)) < 25


def test_the_modality_of_the_surface_may_be_thermal(tmp_path, front, few_photos):
    views = tuple(View(v.name, {THERMAL: v.images[THERMAL]}) for v in few_photos.train)
    alone = replace(few_photos, train=views)
    assert RGB not in alone.modalities
    export(front, alone, "elevation", tmp_path, maps=MapOptions(pixel_size_m=0.2))
    with rasterio.open(tmp_path / "elevation.tif") as file:
        assert np.isnan(file.read(2)).all()
        assert np.nanmedian(file.read(1)) == pytest.approx(WALL_C, abs=0.2)
