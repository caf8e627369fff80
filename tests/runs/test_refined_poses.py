from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mrgs import train_steps
from mrgs.data import load_scene
from mrgs.method.camera_model.pose_refinement import PoseRefinement
from mrgs.method.config import make_config
from mrgs.runs.open import Run, load_run
from mrgs.scene import THERMAL
from tests.helpers.runs import trained_run

STEPS = 12
_PLUS = make_config("mrgs-plus", max_steps=STEPS, max_gaussians=200)
CONFIG = replace(_PLUS, image_model=replace(_PLUS.image_model, poses=True, poses_rate=0.01))
"""Too short for poses to be checked: tests say themselves that they are wrong."""

BEGINS = STEPS // 3


def begin(poses: PoseRefinement) -> None:
    """Refine the poses from here on, as a training does that finds them to be wrong."""
    generator = torch.Generator().manual_seed(0)
    motions = torch.randn(len(poses.motions), 6, generator=generator, dtype=torch.float64)
    poses.begin(0.02 * motions)


@pytest.fixture(scope="module")
def given(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run that could have refined poses, and has not."""
    output = tmp_path_factory.mktemp("given") / "run"
    return load_run(trained_run(tmp_path_factory, small_scene, CONFIG, output))


@pytest.fixture(scope="module")
def run(given: Run) -> Run:
    """The same run with refined poses."""
    refined = load_run(given.folder.path)
    begin(refined.image_model.poses)
    return refined


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
    views = load_scene(small_scene).train
    shifts = run.image_model.poses.shifts()
    shifts_px = shifts * views[0].camera.focal_px
    assert re.findall(r"(\d+\.\d) px", note) == [
        f"{shifts_px.mean():.1f}",
        f"{shifts_px.max():.1f}",
    ]
    assert views[int(shifts.argmax())].name in note


@pytest.mark.parametrize(
    "stop",
    [BEGINS, *(pytest.param(step, marks=pytest.mark.slow) for step in (BEGINS - 1, STEPS // 2))],
)
def test_a_resumed_run_is_the_uninterrupted_run(refined, small_scene, tmp_path, stop):
    refine(small_scene, tmp_path / "run", stop)
    refine(small_scene, tmp_path / "run", STEPS, resume=True)
    resumed = load_run(tmp_path / "run").image_model.poses
    assert resumed.moves
    for name, tensor in refined.image_model.poses.state_dict().items():
        assert torch.equal(resumed.state_dict()[name], tensor), name


@pytest.fixture(scope="module")
def refined(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run that has refined poses while it was trained, without a break."""
    folder = tmp_path_factory.mktemp("refined") / "run"
    refine(small_scene, folder, STEPS)
    return load_run(folder)


def refine(scene: Path, folder: Path, stop: int, resume: bool = False) -> None:
    """Train up to a step, with poses that are refined from step ``BEGINS`` on."""
    for live in train_steps(scene, folder, CONFIG, resume=resume):
        if live.step == BEGINS:
            begin(live._trainer.state.image_model.poses)
        if live.step == stop:
            break


def test_nothing_is_refined_unless_it_is_asked_for(given, small_scene):
    assert given.load_scene().notes == load_scene(small_scene).notes


def test_photos_keep_their_offsets_at_refined_poses(run):
    drift = run.image_model.thermal_drift
    offsets = torch.linspace(-0.1, 0.1, len(drift.residuals))
    drift.begin(offsets, torch.full_like(offsets, 1e8))
    for number, view in enumerate(run.load_scene().train):
        rendering = run.render_view(view)
        added = run.camera_response(rendering, view.camera)[THERMAL].image
        expected = run.image_model(rendering, torch.tensor([number]))[THERMAL].image
        torch.testing.assert_close(added, expected)
        change = (added - rendering[THERMAL].image).mean().item()
        assert change == pytest.approx(offsets[number].item(), abs=0.02)
