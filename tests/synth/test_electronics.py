from __future__ import annotations

from itertools import combinations

import numpy as np

from mrgs_synth import bench
from mrgs_synth import electronics as scene
from mrgs_synth.circuit import Footprint
from mrgs_synth.hits import Triangles, first_hits
from mrgs_synth.radiometry import exact_temperature
from mrgs_synth.stage import Stage


def celsius_of(stage: Stage, name: str, point: tuple[float, float, float]) -> float:
    solid = next(solid for solid in stage.solids if solid.name == name)
    return float(solid.temperature_at(np.array([point]))[0])


def overlap(first: Footprint, second: Footprint) -> bool:
    apart = [abs(first.x_mm - second.x_mm), abs(first.y_mm - second.y_mm)]
    return all(apart[axis] < (first.size_mm[axis] + second.size_mm[axis]) / 2 for axis in (0, 1))


def test_names_are_unique_and_every_surface_is_between_the_air_and_85_degrees(
    circuit_board: Stage,
) -> None:
    assert len({solid.name for solid in circuit_board.solids}) == len(circuit_board.solids)
    for solid in circuit_board.solids:
        celsius = solid.temperature_at(solid.world_mesh().vertices)
        assert np.isfinite(celsius).all(), solid.name
        assert celsius.min() >= 23.5, solid.name
        assert celsius.max() <= 85.0, solid.name


def test_no_two_parts_share_a_place_and_all_are_on_the_board() -> None:
    parts = scene.LARGE_PARTS
    assert not [(a.name, b.name) for a, b in combinations(parts, 2) if overlap(a, b)]
    for part in parts:
        assert abs(part.x_mm) + part.size_mm[0] / 2 <= 80.0, part.name
        assert abs(part.y_mm) + part.size_mm[1] / 2 <= 50.0, part.name


def test_cameras_hover_over_the_bench_outside_everything(circuit_board: Stage) -> None:
    rng = np.random.default_rng(0)
    cameras = circuit_board.cameras.train(40, 32, 24, rng) + circuit_board.cameras.between(
        8, 40, 32, 24, rng
    )
    positions = np.array([camera.position.numpy() for camera in cameras])
    distances = np.linalg.norm(positions - [0.0, 0.0, 0.012], axis=1)
    assert distances.min() > 0.2
    assert distances.max() < 0.4
    for solid in circuit_board.solids:
        vertices = solid.world_mesh().vertices
        inside = (
            (positions > vertices.min(axis=0) - 0.02) & (positions < vertices.max(axis=0) + 0.02)
        ).all(axis=1)
        assert not inside.any(), solid.name


def test_every_ray_meets_a_surface_and_no_camera_sees_a_lamp(circuit_board: Stage) -> None:
    triangles = Triangles.of(circuit_board.solids)
    for camera in circuit_board.cameras.train(8, 48, 36, np.random.default_rng(0)):
        hits = first_hits(camera, triangles)
        assert (hits.solid >= 0).all()
        assert hits.points[..., 2].max() < 0.1


def test_hidden_faults_show(circuit_board: Stage) -> None:
    def board_c(x_mm: float, y_mm: float) -> float:
        return celsius_of(circuit_board, "board", (x_mm / 1000.0, y_mm / 1000.0, scene.TOP_M))

    left, right, height = scene.SHORT_MM
    assert board_c((left + right) / 2, height) > board_c((left + right) / 2, height + 10.0) + 6.0

    def top_c(name: str, parts: tuple[Footprint, ...] = scene.LARGE_PARTS) -> float:
        part = next(part for part in parts if part.name == name)
        return celsius_of(
            circuit_board, f"{name}_top", (*part.centre_m, scene.TOP_M + part.size_m[2])
        )

    assert top_c("C3") > top_c("C1") + 10.0
    assert top_c("Q1") > top_c("Q2") + 20.0


def test_the_mat_is_warm_below_the_board_and_where_it_lay_before(circuit_board: Stage) -> None:
    def mat_c(x: float, y: float) -> float:
        return celsius_of(circuit_board, "mat", (x, y, 0.0))

    far = mat_c(0.2, -0.14)
    assert mat_c(0.0, 0.0) > far + 3.0
    assert mat_c(*bench.BEFORE) > far + 1.0
    assert mat_c(-0.085, 0.0) > mat_c(-0.11, 0.0) + 0.5  # the halo around the board


def test_the_board_is_seeded(circuit_board: Stage) -> None:
    first, again, other = (
        stage.solids[0] for stage in (circuit_board, scene.electronics(0), scene.electronics(1))
    )
    np.testing.assert_array_equal(first.material.texture, again.material.texture)
    assert (first.material.texture != other.material.texture).any()


def test_the_regulator_is_the_hottest_thing_in_view(circuit_board: Stage) -> None:
    triangles = Triangles.of(circuit_board.solids)
    camera = circuit_board.cameras.train(40, 96, 72, np.random.default_rng(0))[12]
    celsius = exact_temperature(camera, circuit_board, triangles, 2)
    row, column = np.unravel_index(celsius.argmax(), celsius.shape)
    assert circuit_board.solids[first_hits(camera, triangles).solid[row, column]].name.startswith(
        "regulator"
    )
    assert celsius.max() > 80.0
    assert celsius.min() < 25.0
