"""Scenes drawn from seeds are usable, repeatable, and differ."""

from __future__ import annotations

import dataclasses
import json
from functools import cache
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from mrgs.data import load_scene
from mrgs.scene import THERMAL, Camera
from mrgs_synth import synthesize
from mrgs_synth.cameras import CameraArc
from mrgs_synth.generate import STAGES
from mrgs_synth.hits import Triangles, first_hits
from mrgs_synth.radiometry import exact_temperature
from mrgs_synth.random_scenes import KINDS, RandomKind, drawn_kind, drawn_stage
from mrgs_synth.random_scenes.checks import faults, unseen
from mrgs_synth.random_scenes.draw import Draw
from mrgs_synth.random_scenes.finishes import EMISSIVITY, GLASS_EMISSIVITY, MIRROR_BELOW
from mrgs_synth.shapes import box
from mrgs_synth.stage import Lamp, Material, Solid, Stage, constant

kinds = pytest.mark.parametrize("kind", get_args(RandomKind))


@cache
def drawn(kind: RandomKind, seed: int) -> Stage:
    return drawn_stage(kind, seed)


def views(stage: Stage, count: int) -> list[Camera]:
    return stage.cameras.train(count, 32, 24, np.random.default_rng([0, 3]))


@pytest.mark.slow
@kinds
def test_the_same_seed_gives_the_same_scene_and_another_seed_another(kind: RandomKind) -> None:
    first, again, other = drawn(kind, 0), drawn_stage(kind, 0), drawn(kind, 1)
    assert [solid.name for solid in first.solids] == [solid.name for solid in again.solids]
    for one, two in zip(first.solids, again.solids, strict=True):
        np.testing.assert_array_equal(one.world_mesh().vertices, two.world_mesh().vertices)
        np.testing.assert_array_equal(one.material.texture, two.material.texture)
        assert one.material.emissivity == two.material.emissivity
        vertices = one.world_mesh().vertices
        np.testing.assert_array_equal(one.temperature_at(vertices), two.temperature_at(vertices))
    assert (first.cameras, first.lamps, first.sensor) == (again.cameras, again.lamps, again.sensor)
    assert [solid.name for solid in first.solids] != [solid.name for solid in other.solids]
    assert first.cameras != other.cameras
    assert first.sensor != other.sensor


@kinds
@pytest.mark.parametrize("seed", [0, 1])
def test_every_camera_sees_surfaces_from_outside(kind: RandomKind, seed: int) -> None:
    stage = drawn(kind, seed)
    triangles = Triangles.of(stage.solids)
    for camera in views(stage, 12):
        hits = first_hits(camera, triangles)
        seen = hits.solid >= 0
        assert seen.mean() >= KINDS[kind].share_seen - 0.02
        assert len(np.unique(hits.solid[seen])) >= 3
        a, b, c = (triangles.corners[hits.triangle[seen], corner] for corner in range(3))
        outwards = (np.cross(b - a, c - a) * (hits.points[seen] - camera.position.numpy())).sum(1)
        assert (outwards > 0.0).mean() < 0.01


@kinds
def test_neighbouring_views_overlap(kind: RandomKind) -> None:
    """Most of what one view sees lies in the next view of the same height too."""
    stage = drawn(kind, 0)
    triangles, cameras = Triangles.of(stage.solids), views(stage, 40)
    step = len(stage.cameras.rings)
    for one, two in zip(cameras[:-step:5], cameras[step::5], strict=False):
        hits = first_hits(one, triangles)
        points = hits.points[hits.solid >= 0]
        at = points @ two.viewmat[:3, :3].numpy().T + two.viewmat[:3, 3].numpy()
        pixel = at @ two.K.numpy().T / at[:, 2:].clip(1e-9)
        inside = (at[:, 2] > 0) & (pixel[:, :2] > 0).all(1) & (pixel[:, :2] < (32, 24)).all(1)
        assert inside.mean() > 0.4


@kinds
def test_temperatures_and_emissivities_are_those_of_the_world(kind: RandomKind) -> None:
    stage = drawn(kind, 0)
    triangles = Triangles.of(stage.solids)
    celsius = np.stack(
        [exact_temperature(camera, stage, triangles, 1) for camera in views(stage, 4)]
    )
    assert -65.0 < celsius.min() < celsius.max() < 130.0
    assert np.ptp(celsius) > 2.0
    for solid in stage.solids:
        material = solid.material
        low, high = EMISSIVITY[material.finish]
        is_pane = GLASS_EMISSIVITY[0] <= material.emissivity <= GLASS_EMISSIVITY[1]
        assert low <= material.emissivity <= high
        assert material.heat_mirror is (
            material.emissivity < MIRROR_BELOW or (material.heat_mirror and is_pane)
        )


@pytest.mark.parametrize("kind", ["room", "machine"])
def test_rooms_are_closed(kind: RandomKind) -> None:
    stage = drawn(kind, 0)
    rng = np.random.default_rng(0)
    for camera in views(stage, 3):
        directions = rng.normal(size=(2000, 3))
        origins = np.broadcast_to(camera.position.numpy(), directions.shape)
        assert np.isfinite(Triangles.of(stage.solids).tree.cast(origins, directions)[0]).all()


def test_seeds_choose_all_kinds() -> None:
    assert {drawn_kind(seed) for seed in range(40)} == set(KINDS) == set(get_args(RandomKind))
    assert set(KINDS) < set(STAGES)
    numbers = [kind.number for kind in KINDS.values()]
    assert len(set(numbers)) == len(numbers)


def test_what_is_wrong_is_found(two_boxes: Stage) -> None:
    grey = Material(np.full((4, 4, 3), 128, dtype=np.uint8))
    third = Solid("third", box(0.2, 0.2, 0.2), grey, constant(20.0), (-0.2, 0.1, 0.0))
    arc = CameraArc((0.0, 0.0, 0.1), (-90.0, 90.0), ((40.0, 1.2), (60.0, 1.2)), jitter_m=0.01)
    good = dataclasses.replace(
        two_boxes, solids=(*two_boxes.solids, third), cameras=arc, sky=None, lamps=()
    )
    assert faults(good, 1.0) == []

    def fault(**change: object) -> str:
        return faults(dataclasses.replace(good, **change), 1.0)[0]

    cage = Solid("cage", box(1.0, 1.0, 1.0), grey, constant(20.0), (0.0, -0.92, 0.4))
    assert "within a solid" in fault(solids=(*good.solids, cage))
    assert "too near" in fault(cameras=dataclasses.replace(arc, jitter_m=0.2))
    assert "at nothing" in fault(cameras=dataclasses.replace(arc, target=(0.0, 0.0, 30.0)))
    assert "fewer than three" in fault(solids=two_boxes.solids)
    lamp = Lamp((0.0, 0.0, 0.3), (0.0, 0.0, 0.0), (0.2, 0.2), (1.0, 1.0, 1.0))
    assert "lamp" in fault(lamps=(lamp,))
    above = dataclasses.replace(lamp, position=(0.0, 0.0, 3.0))
    assert unseen([lamp, above], arc) == (above,)


def test_a_draw_is_even_and_repeats() -> None:
    one, two = Draw([1, 2]), Draw([1, 2])
    assert [one.whole(1, 3) for _ in range(50)] == [two.whole(1, 3) for _ in range(50)]
    assert {one.whole(1, 3) for _ in range(50)} == {1, 2, 3}
    assert {one.one_of("a", "b") for _ in range(50)} == {"a", "b"}
    assert all(2.0 <= one.scale(2.0, 50.0) <= 50.0 for _ in range(50))
    assert sorted(one.some([1, 2, 3, 4], 4)) == [1, 2, 3, 4]
    colour = one.colour((0.0, 0.0), (0.5, 0.5))
    assert colour == (128, 128, 128)


@pytest.mark.slow
def test_a_random_scene_from_end_to_end_twice_the_same(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba", reason="the extra synth is not installed")
    sizes = {"width": 48, "height": 36, "train_views": 2, "eval_views": 1, "samples": 4}
    for name in "ab":
        synthesize(tmp_path / name, scene="random", seed=2, **sizes)
    for path in (tmp_path / "a").rglob("*.*"):
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes()
    made = json.loads((tmp_path / "a/truth/synth.json").read_text())
    assert made["scene"] == "random"
    assert made["kind"] == drawn_kind(2)
    low, high = made["truth"]["emissivity"]
    assert 0.05 <= low < high <= 0.98
    assert 0.03 <= made["thermal_sensor"]["netd_c"] <= 0.15
    scene = load_scene(tmp_path / "a")
    assert (len(scene.train), len(scene.eval)) == (2, 1)
    assert scene.train[0].images[THERMAL].camera.width == 48
