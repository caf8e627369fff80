from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mrgs.data import load_scene
from mrgs.errors import MrgsWarning
from mrgs.method.camera_model.pose_error import PoseAgreement
from mrgs.method.config import TrainConfig, make_config
from mrgs.runs.open import Run, load_run
from mrgs.training import pose_check, train

STEPS = 12


def config(poses: bool = True) -> TrainConfig:
    made = make_config("mrgs-plus", max_steps=STEPS, max_gaussians=200)
    image_model = replace(made.image_model, poses=poses, poses_rate=0.01)
    return replace(made, image_model=image_model)


@pytest.fixture(scope="module", autouse=True)
def every_pose_is_wrong() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pose_check, "EARLIEST_STEP", STEPS // 3)
        patch.setattr(pose_check, "LOOKS", 0)
        patch.setattr(PoseAgreement, "is_wrong", True)
        yield


@pytest.fixture(scope="module")
def run(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("refined") / "run"
    with pytest.warns(MrgsWarning, match="poses of the training photos are off by some"):
        train(small_scene, folder, config())
    return load_run(folder)


def test_training_views_have_the_poses_that_the_model_was_trained_with(run, small_scene):
    found, given = run.load_scene(), load_scene(small_scene)
    assert len(found.train) == len(given.train)
    for number, (own, other) in enumerate(zip(found.train, given.train, strict=True)):
        motion = run.image_model.poses.motion(torch.tensor([number])).detach()
        assert own.cameras.keys() == other.cameras.keys()
        for modality, camera in own.cameras.items():
            before = other.cameras[modality]
            torch.testing.assert_close(camera.viewmat, before.viewmat @ motion)
            assert torch.equal(camera.K, before.K)
            assert not torch.equal(camera.viewmat, before.viewmat)


def test_held_out_views_keep_theirs(run, small_scene):
    found, given = run.load_scene(), load_scene(small_scene)
    for own, other in zip(found.eval, given.eval, strict=True):
        assert torch.equal(own.camera.viewmat, other.camera.viewmat)


def test_the_scene_says_how_far_they_were_moved(run, small_scene):
    (note,) = [note for note in run.load_scene().notes if "poses" in note]
    shifts = run.image_model.poses.shifts()
    views = load_scene(small_scene).train
    camera, farthest = views[0].camera, views[int(shifts.argmax())].name
    assert note == (
        f"the poses of the training photos were refined, by {shifts.mean() * camera.focal_px:.1f} "
        f"px on average and at most {shifts.max() * camera.focal_px:.1f} px "
        f"({farthest})"
    )


@pytest.mark.filterwarnings("ignore:.*so they are refined with the model")
@pytest.mark.parametrize("stop", [STEPS // 3 - 1, STEPS // 3, STEPS // 2])
def test_a_resumed_run_is_the_uninterrupted_run(run, small_scene, tmp_path, stop):
    train(small_scene, tmp_path / "run", config(), stop_at=stop)
    train(small_scene, tmp_path / "run", config(), resume=True)
    resumed = load_run(tmp_path / "run").image_model.poses
    for name, tensor in run.image_model.poses.state_dict().items():
        assert torch.equal(resumed.state_dict()[name], tensor), name


def test_nothing_is_refined_unless_it_is_asked_for(small_scene, tmp_path):
    train(small_scene, tmp_path / "run", config(poses=False), stop_at=STEPS // 2)
    scene = load_run(tmp_path / "run").load_scene()
    assert scene.notes == load_scene(small_scene).notes
