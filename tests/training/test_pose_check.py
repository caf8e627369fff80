from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mrgs import RGB, THERMAL, Camera, Run, Scene, train
from mrgs.errors import MrgsWarning
from mrgs.field import FieldConfig, RadianceField
from mrgs.method.camera_model.pose_error import MOST_PIXELS as MOST_PIXELS_OF_AN_IMAGE
from mrgs.method.camera_model.pose_error import Alignable, pose_error
from mrgs.method.config import TrainConfig, make_config
from mrgs.rasterizer.dilation import Dilation
from mrgs.render import Model, render
from mrgs.scene import Pixels
from mrgs.training import pose_check
from mrgs.training.pose_check import PoseCheck, checked_after, checks_poses_now
from mrgs.training.state import initial_state
from mrgs.training.view_pass import PhotographedView
from tests.helpers.gaussians import random_gaussians

VIEWS = 24
STEPS = 200


def config(**image_model: bool | float) -> TrainConfig:
    made = make_config("mrgs-plus", max_steps=STEPS, max_gaussians=400)
    return replace(made, image_model=replace(made.image_model, **image_model))


def orbit(views: int = VIEWS) -> list[Camera]:
    camera = Camera.from_fov(96, 72, 35)
    angles = [2 * math.pi * number / views for number in range(views)]
    return [
        camera.look_at((5 * math.cos(a), 5 * math.sin(a), 1.5 * (-1) ** number), (0, 0, 0))
        for number, a in enumerate(angles)
    ]


def turned(camera: Camera, pixels: float, generator: torch.Generator) -> Camera:
    """The camera turned about a random axis, so that it sees everything so many pixels away."""
    x, y, _ = torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0).tolist()
    angle = pixels / camera.focal_px / math.hypot(x, y)
    turn = torch.linalg.matrix_exp(
        angle * torch.tensor([[0, 0, y], [0, 0, -x], [-y, x, 0]], dtype=torch.float64)
    )
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = turn
    return Camera(camera.K, viewmat @ camera.viewmat, camera.width, camera.height)


def photographed(wrong_px: float, views: int = VIEWS) -> Scene:
    """Photos of a ball of many colours, from poses that are off by so many pixels."""
    gaussians = random_gaussians(300, bands=0)
    gaussians = replace(
        gaussians,
        means=1.4 * torch.nn.functional.normalize(gaussians.means, dim=1),
        log_scales=torch.full_like(gaussians.log_scales, math.log(0.12)),
        opacity_logits={
            each: torch.full_like(logit, 4.0) for each, logit in gaussians.opacity_logits.items()
        },
    )
    model = Model(
        gaussians,
        RadianceField(FieldConfig(residuals=False)),
        None,
        sh_degree=0,
        dilation=Dilation(0.3),
    )
    with torch.no_grad():
        seen = [render(model, {RGB: camera, THERMAL: camera})[0] for camera in orbit(views)]
    generator = torch.Generator().manual_seed(3)
    return Scene.from_arrays(
        [turned(camera, wrong_px, generator) for camera in orbit(views)],
        rgb=torch.stack([each[RGB].image.clamp(0, 1) for each in seen]),
        celsius=20 + 10 * torch.stack([each[THERMAL].image[:, :, 0] for each in seen]),
        points=gaussians.means.detach(),
        colors=torch.full((300, 3), 0.5),
        eval_every=0,
    )


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


@pytest.fixture(autouse=True)
def early_check(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pose_check, "EARLIEST_STEP", 140)


def logged(folder: Path) -> float:
    lines = map(json.loads, (folder / "log.jsonl").read_text().splitlines())
    (found,) = [line["pose_error_px"] for line in lines if "pose_error_px" in line]
    assert isinstance(found, float)
    return found


def test_wrong_poses_are_found_and_refined(tmp_path):
    scene = photographed(wrong_px=2.0)
    with pytest.warns(MrgsWarning, match="the poses of the training photos are off by some"):
        run = train(scene, tmp_path / "run", config())
    without = train(scene, tmp_path / "without", config(poses=False))
    assert logged(tmp_path / "run") > 0.5
    assert run.image_model.poses.moves
    assert difference(run) < 0.97 * difference(without)


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
        (300, 50, {}, 140),
        (300, 150, {}, 150),
        (300, 300, {}, None),
        (100, 50, {}, None),
        (4000, 50, {"poses": False}, None),
        (4000, 50, {"poses_rate": 0.0}, None),
    ],
)
def test_when_poses_are_checked(steps, views, image_model, expected):
    made = make_config("mrgs-plus", max_steps=steps)
    changed = replace(made, image_model=replace(made.image_model, **image_model))
    assert checked_after(changed, views) == expected


@pytest.mark.parametrize(("views", "expected"), [(600, 150), (601, 151)])
def test_several_views_in_a_step_are_seen_sooner(views, expected):
    made = replace(make_config("mrgs-plus", max_steps=300), batch=4)
    assert checked_after(made, views) == expected


@pytest.mark.parametrize("size", [(96, 72), (640, 480), (507, 380), (321, 243)])
def test_both_halves_of_a_photo_are_sampled(size):
    width, height = size
    step = math.ceil(math.sqrt(width * height / MOST_PIXELS_OF_AN_IMAGE))
    counts = [
        int(pose_check._half(torch.ones(height, width), which)[::step, ::step].isfinite().sum())
        for which in (0, 1)
    ]
    assert min(counts) > 0.4 * sum(counts)


def test_large_photos_are_looked_at_in_larger_pixels(monkeypatch):
    monkeypatch.setattr(pose_check, "MOST_PIXELS", 160 * 200)
    monkeypatch.setattr("mrgs.training.resolution.SMALLEST_PX", 4)
    check = begun_check(photographed(wrong_px=0.0, views=3))
    assert check.pixel_size() == 1
    monkeypatch.setattr(pose_check, "MOST_PIXELS", 24 * 18)
    assert check.pixel_size() == 4
    monkeypatch.setattr(TrainConfig, "pixel_size_at", lambda config, step: 8)
    assert check.pixel_size() == 8


def test_the_largest_photo_of_a_view_decides(monkeypatch):
    monkeypatch.setattr("mrgs.training.resolution.SMALLEST_PX", 4)
    scene = photographed(wrong_px=0.0, views=3)
    views = tuple(
        replace(
            view,
            images=view.images
            | {THERMAL: replace(view.images[THERMAL], camera=view.camera.resized(24, 18))},
        )
        for view in scene.train
    )
    monkeypatch.setattr(pose_check, "MOST_PIXELS", 48 * 36)
    assert begun_check(replace(scene, train=views)).pixel_size() == 2


def test_poses_are_checked_once_and_later_where_that_failed():
    scene, made = photographed(wrong_px=0.0, views=3), config()
    state = initial_state(scene, made)
    found = []
    for state.step in (139, 140, 151):
        found.append(checks_poses_now(state, made))
    state.image_model.poses.note_checked()
    found.append(checks_poses_now(state, made))
    assert found == [False, True, True, False]


def test_of_many_views_some_are_looked_at_from_all_over(monkeypatch):
    monkeypatch.setattr(pose_check, "MOST_VIEWS", 3)
    loaded: list[int] = []
    begun_check(photographed(wrong_px=0.0, views=9), loaded).typical_px()
    assert loaded == [0, 3, 6]


def test_where_halves_of_photos_say_the_contrary_nothing_is_wrong(monkeypatch):
    generator = torch.Generator().manual_seed(0)

    def halves(check: PoseCheck, number: int) -> list[torch.Tensor]:
        found = torch.randn(6, generator=generator, dtype=torch.float64)
        return [found, -found]

    check = begun_check(photographed(wrong_px=0.0, views=6))
    monkeypatch.setattr(PoseCheck, "_halves_px", halves)
    assert check.typical_px() == 0


def test_a_view_of_which_nothing_can_be_told_stays_where_it_is(monkeypatch):
    nothing = torch.tensor([0.1, 0.2, math.nan, 0.1, 0.0, 0.3], dtype=torch.float64)
    monkeypatch.setattr(pose_check, "pose_error", lambda *images: nothing)
    check = begun_check(photographed(wrong_px=0.0, views=3))
    assert torch.equal(check.motions(), torch.zeros(3, 6, dtype=torch.float64))
    assert check.typical_px() == 0


def test_masked_pixels_do_not_count_and_no_gradient_is_kept(monkeypatch):
    seen: list[Alignable] = []

    def watched(images: Sequence[Alignable], *rest: torch.Tensor) -> torch.Tensor:
        seen.extend(images)
        return pose_error(images, *rest)

    monkeypatch.setattr(pose_check, "pose_error", watched)
    scene = photographed(wrong_px=0.0, views=3)
    valid = torch.ones(72, 96, dtype=torch.bool)
    valid[:, 60:] = False
    found = []
    for hidden in (0.0, 1.0):

        def masked(pixels: Pixels, hidden: float = hidden) -> Pixels:
            return Pixels(torch.where(valid[:, :, None], pixels.values, hidden), valid)

        found.append(begun_check(scene, change=masked).motions())
    assert torch.equal(*found)
    assert len(seen) == 2 * 3 * 2
    assert not any(each.rendering.requires_grad or each.depth.requires_grad for each in seen)


def test_what_is_said_of_the_poses_is_in_pixels_of_the_photos(tmp_path, monkeypatch):
    monkeypatch.setattr(pose_check, "EARLIEST_STEP", 4)
    monkeypatch.setattr(PoseCheck, "typical_px", lambda check: 2.0)
    monkeypatch.setattr(PoseCheck, "pixel_size", lambda check: 3.0)
    monkeypatch.setattr(PoseCheck, "motions", lambda check: torch.zeros(3, 6).double())
    made = replace(config(), max_steps=7)
    with pytest.warns(MrgsWarning, match=r"are off by some 6\.0 pixels, so they are refined"):
        train(photographed(wrong_px=0.0, views=3), tmp_path / "run", made)
    lines = map(json.loads, (tmp_path / "run" / "log.jsonl").read_text().splitlines())
    assert [line for line in lines if "pose_error_px" in line] == [
        {"step": 4, "pose_error_px": 6.0}
    ]
