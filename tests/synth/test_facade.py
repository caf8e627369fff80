from __future__ import annotations

import numpy as np
import pytest

from mrgs_synth import facade as scene
from mrgs_synth.hits import Triangles, first_hits
from mrgs_synth.radiometry import exact_temperature
from mrgs_synth.stage import Solid, Stage

OUTSIDE = ("yard", "fields", "hills")


def solid(stage: Stage, name: str) -> Solid:
    return next(solid for solid in stage.solids if solid.name == name)


def wall_c(stage: Stage, x: float, z: float) -> float:
    return float(solid(stage, "wall").temperature_at(np.array([[x, 0.0, z]]))[0])


def test_names_are_unique_and_every_surface_has_a_sane_temperature(house: Stage) -> None:
    assert len({solid.name for solid in house.solids}) == len(house.solids)
    for solid in house.solids:
        celsius = solid.temperature_at(solid.world_mesh().vertices)
        assert np.isfinite(celsius).all(), solid.name
        assert celsius.min() >= -15.0, solid.name
        assert celsius.max() <= 15.0, solid.name


def test_cameras_stand_in_the_yard_in_front_of_the_house(house: Stage) -> None:
    rng = np.random.default_rng(0)
    cameras = house.cameras.train(40, 32, 24, rng) + house.cameras.between(8, 40, 32, 24, rng)
    positions = np.array([camera.position.numpy() for camera in cameras])
    assert (positions[:, 1] < -5.0).all()
    assert (positions[:, 2] > 1.0).all()
    distances = np.linalg.norm(positions - [0.0, 0.0, 3.3], axis=1)
    assert distances.min() > 8.0
    assert distances.max() < 20.0
    for solid in house.solids:
        if solid.name not in OUTSIDE:
            vertices = solid.world_mesh().vertices
            inside = (
                (positions > vertices.min(axis=0) - 0.2) & (positions < vertices.max(axis=0) + 0.2)
            ).all(axis=1)
            assert not inside.any(), solid.name


def test_no_camera_sees_below_the_ground_or_into_the_house(house: Stage) -> None:
    triangles = Triangles.of(house.solids)
    for camera in house.cameras.train(8, 48, 36, np.random.default_rng(0)):
        hits = first_hits(camera, triangles)
        points = hits.points[hits.solid >= 0]
        assert points[:, 2].min() > -0.15
        in_house = (
            (np.abs(points[:, 0]) < 5.9)
            & (points[:, 1] > 0.3)
            & (points[:, 1] < 7.9)
            & (points[:, 2] < 6.7)
        )
        assert not in_house.any()


def test_thermal_bridges_show_on_the_wall(house: Stage) -> None:
    plain = wall_c(house, 5.2, 2.2)
    assert 0.0 < plain < 2.0
    assert wall_c(house, 5.2, scene.SLAB_M) > plain + 1.0
    assert wall_c(house, -4.3, 0.7) > plain + 1.5  # the radiator's niche
    assert wall_c(house, -3.0, 5.2) > plain + 3.0  # the field without insulation
    assert wall_c(house, -0.46, 2.0) > plain + 1.5  # the heating pipe
    assert wall_c(house, 5.9, 0.2) < plain - 0.5  # the damp corner


def test_what_shows_in_thermal_images_alone_is_not_painted_on_the_wall(house: Stage) -> None:
    texture = solid(house, "wall").material.texture.astype(float).mean(axis=2)
    height, width = texture.shape
    rows = slice(round(height * (1 - 6.0 / 7.0)), round(height * (1 - 4.6 / 7.0)))

    def brightness(left: float, right: float) -> float:
        return float(
            texture[
                rows, round((left / 12 + 0.5) * width) : round((right / 12 + 0.5) * width)
            ].mean()
        )

    assert brightness(-3.4, -2.6) == pytest.approx(brightness(2.4, 3.2), abs=8.0)


def test_windows_are_warmer_than_the_wall(house: Stage) -> None:
    for opening in scene.WINDOWS:
        centre = np.array([[opening.x, scene.REVEAL_M, opening.z + opening.height / 2]])
        assert 6.0 < solid(house, f"glass_{opening.name}").temperature_at(centre)[0] < 11.5


def test_the_sky_is_colder_than_everything_and_coldest_above() -> None:
    directions = np.array([[0.0, 1.0, 0.0], [0.0, np.cos(0.3), np.sin(0.3)], [0.0, 0.0, 1.0]])
    horizon, above, zenith = scene.sky_c(directions)
    assert -20.0 < horizon < -15.0
    assert zenith < above < horizon
    assert zenith == pytest.approx(-31.0, abs=0.1)


def test_sky_snow_and_bonnet_are_in_view(house: Stage) -> None:
    triangles = Triangles.of(house.solids)
    camera = house.cameras.train(40, 64, 48, np.random.default_rng(0))[37]
    celsius = exact_temperature(camera, house, triangles, 2)
    assert celsius.min() < -25.0
    assert celsius.max() > 8.0
    names = {
        house.solids[index].name
        for index in np.unique(first_hits(camera, triangles).solid)
        if index >= 0
    }
    assert {"wall", "roof", "yard", "car_body"} <= names
