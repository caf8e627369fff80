from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mrgs import RGB, THERMAL, Run, Scene, train
from mrgs.errors import MrgsWarning
from mrgs.method.camera_model.pose_error import PoseAgreement
from mrgs.method.config import TrainConfig, make_config
from mrgs.scene import Camera, Modality, Pixels
from mrgs.scene.view import evenly_spaced
from mrgs.training.pose_check import (
    EARLIEST_STEP,
    MOST_VIEWS,
    PoseCheck,
    checked_after,
    checks_poses_now,
    looked_at,
)
from mrgs.training.state import initial_state
from mrgs.training.view_pass import PhotographedView
from tests.helpers.colored_ball import photographed

STEPS = 260


def config(**image_model: bool | float) -> TrainConfig:
    made = make_config("mrgs-plus", max_steps=STEPS, max_gaussians=400)
    return replace(made, image_model=replace(made.image_model, **image_model))


def difference(run: Run) -> float:
    """Mean difference between the training photos and what the model shows at their poses."""
    views = run.load_scene().train
    apart = [
        (run.render(view.camera)[RGB].image - view.images[RGB].load().values).abs()
        for view in views
    ]
    return torch.stack(apart).mean().item()


def begun_check(
    scene: Scene,
    loaded: list[int] | None = None,
    change: Callable[[Pixels], Pixels] = lambda pixels: pixels,
) -> PoseCheck:
    """Of the model at the start of a training, whose step is a later one.

    Args:
        scene: to train on.
        loaded: gets the numbers of the views that are looked at.
        change: of the photos.
    """
    made = config()
    state = initial_state(scene, made)
    state.step = STEPS

    def load(number: int) -> PhotographedView:
        if loaded is not None:
            loaded.append(number)
        view = scene.train[number]
        photos = {modality: change(image.load()) for modality, image in view.images.items()}
        return PhotographedView(number, view, photos)

    return PoseCheck(state, load, made)


def logged(folder: Path) -> float:
    lines = map(json.loads, (folder / "log.jsonl").read_text().splitlines())
    (found,) = [line["pose_error_px"] for line in lines if "pose_error_px" in line]
    assert isinstance(found, float)
    return found


@pytest.mark.slow
def test_wrong_poses_are_found_and_refined(tmp_path):
    scene = photographed(wrong_px=2.0)
    with pytest.warns(MrgsWarning, match="poses .* pixels"):
        run = train(scene, tmp_path / "run", config())
    without = train(scene, tmp_path / "without", config(poses=False))
    assert logged(tmp_path / "run") > 0.5
    assert run.image_model.poses.moves
    assert difference(run) < 0.97 * difference(without)


@pytest.mark.slow
def test_right_poses_stay_as_they_are_and_the_model_is_the_same(tmp_path):
    scene = photographed(wrong_px=0.0)
    run = train(scene, tmp_path / "run", config())
    without = train(scene, tmp_path / "without", config(poses=False))
    assert logged(tmp_path / "run") < 0.3
    assert not run.image_model.poses.moves
    assert not any("poses" in note for note in run.load_scene().notes)
    for name, tensor in run.model.gaussians.tensors().items():
        assert torch.equal(tensor, without.model.gaussians.tensors()[name]), name


@pytest.mark.parametrize(
    ("steps", "views", "image_model", "expected"),
    [
        (4000, 50, {}, 400),
        (300, 50, {}, 200),
        (300, 120, {}, 240),
        (300, 150, {}, None),
        (200, 50, {}, None),
        (4000, 50, {"poses": False}, None),
        (4000, 50, {"poses_rate": 0.0}, None),
    ],
)
def test_when_poses_are_checked(steps, views, image_model, expected):
    made = make_config("mrgs-plus", max_steps=steps)
    changed = replace(made, image_model=replace(made.image_model, **image_model))
    assert checked_after(changed, views) == expected


@pytest.mark.parametrize(("views", "expected"), [(440, 220), (441, 221)])
def test_several_views_in_a_step_are_seen_sooner(views, expected):
    made = replace(make_config("mrgs-plus", max_steps=300), batch=4)
    assert checked_after(made, views) == expected


def looked_at_widths(
    sizes: Mapping[Modality, tuple[int, int]], pixel_size: int = 1
) -> dict[Modality, int]:
    """How wide photos of these sizes are looked at."""
    cameras = {each: Camera.from_fov(*size, 60.0) for each, size in sizes.items()}
    photos = {
        each: Pixels(torch.zeros(height, width, each.channels))
        for each, (width, height) in sizes.items()
    }
    seen, pixels = looked_at(cameras, photos, pixel_size)
    widths = {each: photo.values.shape[1] for each, photo in pixels.items()}
    assert widths == {each: camera.width for each, camera in seen.items()}
    return widths


def test_large_photos_are_looked_at_in_larger_pixels():
    assert looked_at_widths({RGB: (640, 480)}) == {RGB: 640}
    assert looked_at_widths({RGB: (644, 480)}) == {RGB: 322}
    assert looked_at_widths({RGB: (1400, 900)}) == {RGB: 350}
    assert looked_at_widths({RGB: (1280, 960)}, pixel_size=4) == {RGB: 320}
    assert begun_check(photographed(0.0, 1000, 500, views=2)).pixel_size() == 2


def test_the_largest_photo_of_a_view_decides():
    sizes = {RGB: (800, 600), THERMAL: (640, 480)}
    assert looked_at_widths(sizes) == {RGB: 400, THERMAL: 320}


def test_poses_are_checked_once_and_later_where_that_failed():
    scene, made = photographed(wrong_px=0.0, views=3), config()
    state = initial_state(scene, made)
    found = []
    for state.step in (199, 200, 211):
        found.append(checks_poses_now(state, made))
    state.image_model.poses.note_checked()
    found.append(checks_poses_now(state, made))
    assert found == [False, True, True, False]


@pytest.mark.slow
def test_of_many_views_some_are_looked_at_from_all_over():
    loaded: list[int] = []
    begun_check(photographed(wrong_px=0.0, views=MOST_VIEWS + 8), loaded).agreement()
    assert loaded == evenly_spaced(MOST_VIEWS + 8, MOST_VIEWS)


def test_masked_pixels_do_not_count_and_no_gradient_is_kept():
    scene = photographed(wrong_px=0.0, views=3)
    valid = torch.ones(72, 96, dtype=torch.bool)
    valid[:, 60:] = False
    found, with_gradients = [], []
    for hidden in (0.0, 1.0):

        def masked(pixels: Pixels, hidden: float = hidden) -> Pixels:
            with_gradients.append(torch.is_grad_enabled())
            return Pixels(torch.where(valid[:, :, None], pixels.values, hidden), valid)

        found.append(begun_check(scene, change=masked).motions())
    assert torch.equal(*found)
    assert with_gradients == [False] * (2 * 3 * 2)


@pytest.mark.slow
def test_what_is_said_of_the_poses_is_in_pixels_of_the_photos(tmp_path, monkeypatch):
    monkeypatch.setattr(PoseCheck, "agreement", lambda check: PoseAgreement(2.0, 0.0))
    monkeypatch.setattr(PoseCheck, "pixel_size", lambda check: 3.0)
    made = replace(config(), max_steps=EARLIEST_STEP + 1)
    with pytest.warns(MrgsWarning, match=r"6\.0 pixels"):
        train(photographed(wrong_px=0.0, views=3), tmp_path / "run", made)
    lines = map(json.loads, (tmp_path / "run" / "log.jsonl").read_text().splitlines())
    assert [line for line in lines if "pose_error_px" in line] == [
        {"step": EARLIEST_STEP, "pose_error_px": 6.0}
    ]
