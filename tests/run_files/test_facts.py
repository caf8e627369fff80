"""Whether a scene is still the one that a run began with."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import pytest
import torch

from mrgs.errors import RunError
from mrgs.run_files.facts import CheckpointFacts, facts_to_resume
from mrgs.scene import RGB, THERMAL, Camera, Pixels, PosedImage, Scene, TemperatureRange, View
from mrgs_compare.plan import differences
from tests.helpers.gaussians import NEAR_INFRARED

LENS = Camera.from_fov(12, 10, 60)
CAMERAS = [LENS.look_at((x, -4.0, 1.0), (0.0, 0.0, 0.0)) for x in (-1.0, 0.0, 1.0)]


def scene_of(thermal: Collection[int] = (0, 1, 2)) -> Scene:
    """Three views, some of them with a thermal photo."""
    random = torch.Generator().manual_seed(0)
    celsius = 20 + 5 * torch.rand(3, 10, 12, generator=random)
    celsius[:, 0, 0], celsius[:, 0, 1] = 20, 25
    return Scene.from_arrays(
        CAMERAS,
        rgb=torch.rand(3, 10, 12, 3, generator=random),
        celsius=[celsius[number] if number in thermal else None for number in range(3)],
        points=torch.rand(30, 3, generator=random),
        eval_every=0,
    )


def changed(scene: Scene, number: int, **images: PosedImage) -> Scene:
    """The scene with other images in one of its views."""
    view = scene.train[number]
    known = {each.name: each for each in (RGB, THERMAL, NEAR_INFRARED)}
    images_now = view.images | {known[name]: image for name, image in images.items()}
    views = list(scene.train)
    views[number] = View(view.name, images_now)
    return replace(scene, train=tuple(views))


def test_a_scene_that_is_the_same_is_gone_on_with():
    facts = CheckpointFacts.at_start(scene_of())
    assert facts_to_resume(facts, scene_of()) == facts
    assert differences(facts, scene_of()) == ""


def test_thermal_photos_of_other_views_are_another_scene():
    facts = CheckpointFacts.at_start(scene_of(thermal=(0, 1)))
    for accept_changes in (False, True):
        with pytest.raises(RunError, match="thermal photos"):
            facts_to_resume(facts, scene_of(thermal=(1, 2)), accept_changes)


def test_a_modality_that_the_model_has_not_learned_cannot_be_added():
    scene = scene_of()
    facts = CheckpointFacts.at_start(scene)
    more = changed(scene, 1, nir=scene.train[1].images[THERMAL])
    with pytest.raises(RunError, match=r"\(nir\): retrain"):
        facts_to_resume(facts, more, accept_changes=True)


def test_a_mask_alone_makes_another_photo():
    scene = scene_of()
    facts = CheckpointFacts.at_start(scene)
    image = scene.train[2].images[RGB]
    pixels = image.load()
    valid = torch.ones(10, 12, dtype=torch.bool)
    valid[3, 4] = False
    masked = replace(image, load=lambda: Pixels(pixels.values, valid))
    with pytest.raises(RunError, match=r"photos of 00002 \(rgb\)"):
        facts_to_resume(facts, changed(scene, 2, rgb=masked))


@pytest.mark.parametrize("place", [(0, 0), (1, 1), (0, 2), (1, 2)], ids=["fx", "fy", "cx", "cy"])
def test_each_of_the_intrinsics_counts(place):
    scene = scene_of()
    facts = CheckpointFacts.at_start(scene)
    image = scene.train[1].images[THERMAL]
    K = image.camera.K.clone()
    K[place] *= 1.001
    camera = Camera(K, image.camera.viewmat, image.camera.width, image.camera.height)
    other = changed(scene, 1, thermal=replace(image, camera=camera))
    assert differences(facts, other) == "intrinsics of 00001 (thermal)"


def test_another_range_of_temperatures_is_named():
    scene = scene_of()
    facts = CheckpointFacts.at_start(scene)
    other = replace(scene, temperature=TemperatureRange(scene.temperature.min_c, 99.0))
    assert "temperature" in differences(facts, other)
    with pytest.raises(RunError, match="temperature range"):
        facts_to_resume(facts, other, accept_changes=True)
