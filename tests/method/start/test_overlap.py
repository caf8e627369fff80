from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import torch

from mrgs import make_config, train
from mrgs.errors import ConfigError, MrgsWarning
from mrgs.method.camera_model.image_model import ImageModel, ImageModelConfig
from mrgs.method.start.overlap import find_from_overlap, without_camera
from mrgs.scene import THERMAL, Camera, Pixels, Scene
from mrgs.scene.capture import Capture
from mrgs.scene.radiometry import ZERO_CELSIUS_K, PhotoRecord
from tests.helpers.drifting import (
    HEIGHT,
    PAUSE,
    PHOTOS,
    WIDTH,
    drifting_scene,
    offsets_c,
    shading_c,
)

BOTH = ImageModelConfig(thermal_drift=True, thermal_shading=True)


def started(scene: Scene, config: ImageModelConfig = BOTH) -> ImageModel:
    model = ImageModel(config, Capture.of(scene))
    find_from_overlap(scene, model, config)
    return model


def error_c(found: torch.Tensor, scene: Scene, true: torch.Tensor) -> float:
    assert scene.temperature is not None
    return (found * scene.temperature.span_c - true).abs().max().item()


def spread_c(scene: Scene) -> float:
    """How far the photos differ at the same points, standard deviation, °C."""
    assert scene.temperature is not None
    values = torch.full((len(scene.train), len(scene.points.positions)), torch.nan)
    for row, view in enumerate(scene.train):
        image = view.images[THERMAL]
        pixels, _ = image.camera.project(scene.points.positions.double())
        seen = image.camera.contains(pixels)
        column, line = pixels[seen].long().T
        values[row, seen] = image.load().values[line, column, 0]
    mean = values.nanmean(dim=0)
    return (values - mean).square().nanmean().sqrt().item() * scene.temperature.span_c


def test_offsets_with_a_jump_and_a_shading_are_found_from_the_overlap():
    scene = drifting_scene()
    model = started(scene)
    assert error_c(model.thermal_drift.offsets(), scene, offsets_c()) < 0.1
    assert error_c(model.thermal_shading(HEIGHT, WIDTH)[..., 0], scene, shading_c()) < 0.1
    assert model.thermal_drift.offsets().sum().item() == pytest.approx(0, abs=1e-5)
    assert spread_c(scene) > 1.5
    assert spread_c(without_camera(scene, model)) < 0.1


def test_each_effect_can_be_knocked_out():
    scene = drifting_scene(shading=0)
    only_drift = started(scene, replace(BOTH, thermal_shading=False))
    assert only_drift.thermal_shading is None
    assert error_c(only_drift.thermal_drift.offsets(), scene, offsets_c()) < 0.1
    scene = drifting_scene(drift=0)
    only_shading = started(scene, replace(BOTH, thermal_drift=False))
    assert only_shading.thermal_drift is None
    assert error_c(only_shading.thermal_shading(HEIGHT, WIDTH)[..., 0], scene, shading_c()) < 0.1
    assert without_camera(scene, started(scene, ImageModelConfig())) is scene


def test_photos_that_agree_get_neither():
    scene = drifting_scene(drift=0, shading=0)
    model = started(scene)
    assert error_c(model.thermal_drift.offsets(), scene, torch.tensor(0.0)) < 0.03
    assert error_c(model.thermal_shading(HEIGHT, WIDTH), scene, torch.tensor(0.0)) < 0.05


def test_what_is_smeared_off_the_middle_is_no_shading():
    scene = drifting_scene(drift=0, shading=0, lines_c=20.0)
    model = started(scene)
    assert error_c(model.thermal_shading(HEIGHT, WIDTH), scene, torch.tensor(0.0)) < 0.2


def test_a_photo_that_overlaps_with_none_drifts_like_those_before_and_after_it():
    scene = drifting_scene(shading=0)
    views = list(scene.train)
    image = views[5].images[THERMAL]
    away = Camera(image.camera.K, image.camera.viewmat, WIDTH, HEIGHT).look_at([0, 0, 3], [9, 0, 5])
    views[5] = replace(views[5], images={THERMAL: replace(image, camera=away)})
    scene = replace(scene, train=tuple(views))
    offsets = started(scene).thermal_drift.offsets() * scene.temperature.span_c
    assert offsets[5].item() == pytest.approx(offsets[[4, 6]].mean().item(), abs=0.2)
    assert offsets[PAUSE] - offsets[PAUSE - 1] == pytest.approx(-6.5, abs=0.2)


def test_what_stands_before_the_camera_in_one_photo_is_no_offset():
    scene = drifting_scene()
    views = list(scene.train)
    image = views[7].images[THERMAL]

    def look(width: int | None = None) -> Pixels:
        pixels = image.load() if width is None else image.look(width)
        values = pixels.values.clone()
        values[:, : 2 * values.shape[1] // 3] = values.max()
        return replace(pixels, values=values)

    views[7] = replace(views[7], images={THERMAL: replace(image, load=look, load_at_least=look)})
    scene = replace(scene, train=tuple(views))
    assert error_c(started(scene).thermal_drift.offsets(), scene, offsets_c()) < 0.3


def test_a_single_photo_may_be_off_though_the_next_ones_follow_within_a_second():
    scene, off = drifting_scene(drift=0, shading=0), torch.zeros(PHOTOS).double()
    off[7] = 4.0
    views = []
    for number, view in enumerate(scene.train):
        image, record = view.images[THERMAL], PhotoRecord(taken=datetime(2024, 1, 1, 0, 0, number))

        def look(width: int | None = None, image=image, number=number) -> Pixels:
            pixels = image.load() if width is None else image.look(width)
            values = pixels.values + float(off[number]) / scene.temperature.span_c
            return replace(pixels, values=values)

        changed = replace(image, load=look, load_at_least=look, record=record)
        views.append(replace(view, images={THERMAL: changed}))
    few = replace(scene.points, positions=scene.points.positions[::8], colors=None)
    scene = replace(scene, train=tuple(views), points=few)
    assert error_c(started(scene).thermal_drift.offsets(), scene, off - off.mean()) < 0.1


def test_drawn_points_say_nothing():
    scene = drifting_scene()
    scene = replace(scene, points=replace(scene.points, random=True))
    model = started(scene)
    assert not model.thermal_drift.offsets().any()
    assert not model.thermal_shading.coefficients.any()


def flat_field(folder: Path, width: int = WIDTH, height: int = HEIGHT, zero: float = 0.0) -> str:
    """Photos of a uniform target in °C above ``zero``."""
    folder.mkdir()
    rng = np.random.default_rng(2)
    for number in range(3):
        celsius = np.zeros((height, width))
        if (height, width) == (HEIGHT, WIDTH):
            celsius = shading_c().numpy()
        celsius = celsius + 20 + number + rng.normal(0, 0.03, celsius.shape)
        np.savetxt(folder / f"{number}.csv", celsius + zero, fmt="%.3f", delimiter=",")
    return str(folder)


def test_a_flat_field_fixes_the_shading(tmp_path):
    scene = drifting_scene()
    config = replace(BOTH, flat_field=flat_field(tmp_path / "flat"))
    model = ImageModel(config, Capture.of(scene))
    find_from_overlap(scene, model, config)
    assert model.thermal_shading.fixed
    assert error_c(model.thermal_shading(HEIGHT, WIDTH)[..., 0], scene, shading_c()) < 0.1
    assert error_c(model.thermal_drift.offsets(), scene, offsets_c()) < 0.1


def test_a_flat_field_of_another_day_is_told(tmp_path):
    config = replace(BOTH, flat_field=flat_field(tmp_path / "flat"))
    scene = drifting_scene(shading=-1.0)
    with pytest.warns(MrgsWarning, match=f"differs by {2 * shading_c().std():.1f} °C"):
        find_from_overlap(scene, ImageModel(config, Capture.of(scene)), config)


def test_the_guessed_unit_of_a_flat_field_is_told_once(tmp_path):
    config = replace(BOTH, flat_field=flat_field(tmp_path / "flat", zero=ZERO_CELSIUS_K))
    scene = drifting_scene()
    with pytest.warns(MrgsWarning, match="taken for kelvin") as told:
        find_from_overlap(scene, ImageModel(config, Capture.of(scene)), config)
    assert len(told) == 1


def test_the_unit_of_a_flat_field_can_be_stated(tmp_path):
    scene, folder = drifting_scene(), Path(flat_field(tmp_path / "flat"))
    for path in folder.iterdir():
        celsius = np.loadtxt(path, delimiter=",")
        np.savetxt(path, (celsius + 100) * 40, fmt="%d", delimiter=",")
    config = replace(BOTH, flat_field=str(folder), flat_field_unit="(celsius+100)*40")
    model = ImageModel(config, Capture.of(scene))
    find_from_overlap(scene, model, config)
    assert error_c(model.thermal_shading(HEIGHT, WIDTH)[..., 0], scene, shading_c()) < 0.1
    with pytest.raises(ConfigError, match="furlongs") as caught:
        find_from_overlap(scene, model, replace(config, flat_field_unit="furlongs"))
    assert caught.value.options == ("flat_field_unit",)


def test_photos_without_celsius_take_no_flat_field(tmp_path):
    scene = replace(drifting_scene(), temperature=None)
    config = replace(BOTH, flat_field=flat_field(tmp_path / "flat"))
    with pytest.raises(ConfigError, match="no °C") as caught:
        find_from_overlap(scene, ImageModel(config, Capture.of(scene)), config)
    assert caught.value.options == ("flat_field",)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: flat_field(path, 32, 24), "same camera"),
        (lambda path: path.mkdir() or str(path), "no photos"),
        (str, "no photos"),
    ],
)
def test_a_flat_field_that_cannot_be_used_is_named(tmp_path, make, words):
    scene, config = drifting_scene(), replace(BOTH, flat_field=make(tmp_path / "flat"))
    with pytest.raises(ConfigError, match=words) as caught:
        find_from_overlap(scene, ImageModel(config, Capture.of(scene)), config)
    assert caught.value.options == ("flat_field",)


@pytest.mark.slow
def test_what_was_found_stays_while_the_model_is_trained():
    scene = drifting_scene()
    run = train(scene, config=make_config(preset="fast", max_steps=40, max_gaussians=1_000))
    model = run.image_model
    assert error_c(model.thermal_drift.offsets(), scene, offsets_c()) < 0.1
    assert error_c(model.thermal_shading(HEIGHT, WIDTH)[..., 0], scene, shading_c()) < 0.15
