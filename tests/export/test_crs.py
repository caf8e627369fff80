from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyproj
import pytest

from mrgs.errors import ConfigError
from mrgs.maps.crs import coordinate_system, local_wkt
from mrgs.scene import EarthPosition, Scene, WorldFrame

PRAGUE, CAPE_TOWN, MUNICH = (50.08, 14.42), (-33.9, 18.4), (48.137, 11.575)


def at(scene: Scene, latitude: float, longitude: float) -> Scene:
    origin = EarthPosition(latitude, longitude, 40.0)
    return replace(scene, world=WorldFrame(metric=True, north=True, origin=origin))


@pytest.mark.parametrize(
    ("crs", "place"),
    [
        ("EPSG:5514", PRAGUE),
        ("EPSG:31468", MUNICH),  # northing first
        ("EPSG:3035", MUNICH),  # northing first, equal areas
        ("EPSG:2048", CAPE_TOWN),  # westing, southing
        ("EPSG:3413", (70.0, 20.0)),  # southing, southing
        ("EPSG:32761", (-86.0, 100.0)),  # northing, northing
    ],
)
def test_coordinates_are_those_that_gis_expect(scene, crs, place):
    system = coordinate_system(at(scene, *place), crs)
    local = pyproj.Proj(proj="aeqd", lat_0=place[0], lon_0=place[1], ellps="WGS84")
    points = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 1.0], [0.0, 3.0, 2.0], [-2.0, -1.0, 3.0]])
    longitude, latitude = local(*points[:, :2].T, inverse=True)
    to_map = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    expected = np.stack(to_map.transform(longitude, latitude), axis=1)
    found = system.apply(points)
    np.testing.assert_allclose(found[:, :2], expected, atol=0.1)
    np.testing.assert_allclose(found[:, :2] - found[0, :2], expected - expected[0], atol=0.05)
    np.testing.assert_allclose(found[:, 2], 40.0 + points[:, 2])


@pytest.mark.parametrize(
    ("crs", "place", "message"),
    [
        ("EPSG:5513", PRAGUE, "south and west.*mirror"),
        ("EPSG:2065", PRAGUE, "Krovak.*mirror"),
        ("EPSG:3857", PRAGUE, r"1\.56 m"),
        ("EPSG:6933", PRAGUE, r"\d\d%"),
        ("EPSG:32633", (50.08, 104.42), "cover|coordinates"),
        ("EPSG:25832", (-30.0, 9.0), r"-30\.0000°"),
        ("EPSG:3832", (0.0, -30.0), r" 0\.0000°"),
        ("EPSG:3994", (-26.0, 170.0), r"0\.84 m"),
    ],
)
def test_a_crs_in_which_the_scene_would_be_another_is_refused(scene, crs, place, message):
    with pytest.raises(ConfigError, match=message) as caught:
        coordinate_system(at(scene, *place), crs)
    assert caught.value.options == ("crs",)


@pytest.mark.parametrize(
    ("crs", "place", "north_deg", "is_up"),
    [
        (None, (60.0, 12.0), 2.6, True),  # at the edge of its zone
        ("EPSG:5514", PRAGUE, 7.8, False),
        ("EPSG:2048", CAPE_TOWN, 180.0, False),
        ("EPSG:3413", (70.0, 20.0), -65.0, False),
    ],
)
def test_where_north_is(scene, crs, place, north_deg, is_up):
    system = coordinate_system(at(scene, *place), crs)
    assert system.north_deg is not None
    assert abs((system.north_deg - north_deg + 180) % 360 - 180) < 0.6
    assert system.north is is_up
    there = pyproj.Transformer.from_crs("EPSG:4326", crs or "EPSG:32633", always_xy=True)
    x, y = np.diff(there.transform([place[1]] * 2, [place[0], place[0] + 1e-4]))[:, 0]
    turned = np.degrees(np.arctan2(x, y))
    assert abs((system.north_deg - turned + 180) % 360 - 180) < 0.01


def test_a_scene_without_a_place_has_no_north(scene):
    system = coordinate_system(replace(scene, world=WorldFrame(metric=True)))
    assert system.north_deg is None
    assert not system.north


@pytest.mark.parametrize(
    ("place", "code"),
    [
        ((0.5, 9.0), 32632),
        ((-0.5, 9.0), 32732),
        ((48.0, 180.0), 32660),
        ((48.0, -180.0), 32601),
        ((48.0, 5.99), 32631),
        ((48.0, 6.0), 32632),
    ],
)
def test_the_zone_is_that_of_the_place(scene, place, code):
    assert coordinate_system(at(scene, *place)).name.startswith(f"EPSG:{code}, WGS 84 / UTM zone")


@pytest.mark.parametrize("longitude", [179.0, -179.0])
def test_a_crs_may_cover_both_sides_of_the_date_line(scene, longitude):
    """The area of NZGD2000's continental shelf reaches from 160.6° east to 171.2° west."""
    assert coordinate_system(at(scene, -44.0, longitude), "EPSG:3851").on_earth


def test_the_name_of_a_local_crs_is_plain_text():
    wkt = local_wkt('Großes "Haus" [Süd], Łódź\n')
    assert wkt.startswith('LOCAL_CS["Grosses Haus Sud, odz",LOCAL_DATUM[')
