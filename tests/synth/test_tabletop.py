from __future__ import annotations

import numpy as np

from mrgs_synth import tabletop as scene
from mrgs_synth.hits import Triangles, first_hits
from mrgs_synth.radiometry import exact_temperature
from mrgs_synth.stage import Stage

ROOM = ("floor", "wall")


def test_names_are_unique_and_every_surface_has_a_sane_temperature(table: Stage) -> None:
    assert len({solid.name for solid in table.solids}) == len(table.solids)
    for solid in table.solids:
        celsius = solid.temperature_at(solid.world_mesh().vertices)
        assert np.isfinite(celsius).all(), solid.name
        assert celsius.min() >= -0.01, solid.name
        assert celsius.max() <= 90.0, solid.name


def test_cameras_are_inside_the_room_and_outside_everything_else(table: Stage) -> None:
    rng = np.random.default_rng(0)
    cameras = table.cameras.train(40, 32, 24, rng) + table.cameras.between(8, 40, 32, 24, rng)
    positions = np.array([camera.position.numpy() for camera in cameras])
    for solid in table.solids:
        if not solid.name.startswith(ROOM):
            vertices = solid.world_mesh().vertices
            inside = (
                (positions > vertices.min(axis=0) - 0.1) & (positions < vertices.max(axis=0) + 0.1)
            ).all(axis=1)
            assert not inside.any(), solid.name
    room = np.concatenate(
        [s.world_mesh().vertices for s in table.solids if s.name.startswith(ROOM)]
    )
    assert (positions > room.min(axis=0) + 0.05).all()
    assert (positions < room.max(axis=0) - 0.05).all()


def test_every_ray_meets_a_surface_and_no_camera_sees_a_lamp(table: Stage) -> None:
    triangles = Triangles.of(table.solids)
    lowest_lamp = min(
        lamp.position[2] - max(lamp.size_m) / 2 for lamp in table.lamps if lamp.size_m[0] < 2.0
    )
    for camera in table.cameras.train(10, 48, 36, np.random.default_rng(0)):
        hits = first_hits(camera, triangles)
        assert (hits.solid >= 0).all()
        assert hits.points[..., 2].max() < lowest_lamp


def test_table_top_carries_halos(table: Stage) -> None:
    top = next(solid for solid in table.solids if solid.name == "table_top")

    def beside(place: tuple[float, float, float], distance: float) -> float:
        point = np.array([[place[0], place[1] - distance, 0.0]])
        return float(top.temperature_at(point)[0])

    assert beside(scene.KETTLE, 0.1) > scene.AMBIENT_C + 10.0
    assert beside(scene.CAN, 0.04) < scene.AMBIENT_C - 3.0
    assert beside(scene.GHOST_RING, 0.035) > beside(scene.GHOST_RING, 0.0) > scene.AMBIENT_C + 1.0
    assert beside(scene.KETTLE, 0.1) > beside(scene.KETTLE, 0.13) > beside(scene.KETTLE, 0.2)


def test_cloth_has_the_temperature_of_the_table_under_it(table: Stage) -> None:
    by_name = {solid.name: solid for solid in table.solids}
    points = by_name["cloth"].world_mesh().vertices
    points = points[points[:, 2] > 0.001]
    np.testing.assert_allclose(
        by_name["cloth"].temperature_at(points),
        by_name["table_top"].temperature_at(points),
        atol=1e-6,
    )


def test_hot_and_cold_are_both_in_view(table: Stage) -> None:
    camera = table.cameras.train(3, 64, 48, np.random.default_rng(0))[1]
    celsius = exact_temperature(camera, table, Triangles.of(table.solids), 2)
    assert celsius.max() > 75.0
    assert celsius.min() < 8.0
