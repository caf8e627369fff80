from __future__ import annotations

import numpy as np
import pytest

from mrgs.data.earth import SEMI_MAJOR_AXIS_M, ecef, enu, geodetic
from mrgs.data.radiometric import GpsPosition


def test_ecef_on_the_axes():
    assert ecef(GpsPosition(0, 0, 0)) == pytest.approx([SEMI_MAJOR_AXIS_M, 0, 0])
    assert ecef(GpsPosition(0, 90, 10)) == pytest.approx([0, SEMI_MAJOR_AXIS_M + 10, 0], abs=1e-8)
    assert ecef(GpsPosition(90, 0, 0)) == pytest.approx([0, 0, 6356752.3142], abs=1e-3)


def test_ecef_of_a_published_place():
    """Zugspitze: latitude 47.421111, longitude 10.985278, height 2962 m; coordinates by the closed
    formula in PROJ."""
    assert np.linalg.norm(ecef(GpsPosition(47.421111, 10.985278, 2962.0))) == pytest.approx(
        6369.5e3, rel=2e-4
    )


def test_enu_counts_metres_east_north_and_up():
    origin = GpsPosition(48.0, 11.0, 500.0)
    north = GpsPosition(48.0 + 1e-4, 11.0, 500.0)
    east = GpsPosition(48.0, 11.0 + 1e-4, 500.0)
    up = GpsPosition(48.0, 11.0, 507.0)
    # A degree on the ellipsoid at 48° is 111.200 km northward and 74.630 km eastward (500 m up:
    # 8e-5 more).
    expected = [[0, 11.120, 0], [7.463, 0, 0], [0, 0, 7.0]]
    assert enu([north, east, up], origin) == pytest.approx(np.array(expected), abs=3e-3)


def test_an_unknown_height_is_zero():
    assert ecef(GpsPosition(48, 11)) == pytest.approx(ecef(GpsPosition(48, 11, 0.0)))


def test_offsets_lead_back_to_positions():
    origin = GpsPosition(-33.9, 151.2, 40.0)
    there = GpsPosition(-33.91, 151.22, 95.0)
    (offset,) = enu([there], origin)
    back = geodetic(offset, origin)
    assert (back.latitude_deg, back.longitude_deg) == pytest.approx((-33.91, 151.22), abs=1e-10)
    assert back.altitude_m == pytest.approx(95.0, abs=1e-6)
