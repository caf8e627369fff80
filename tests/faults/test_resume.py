"""A resumed run is the same run: photos, poses and intrinsics are compared."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from PIL import Image

from mrgs.app.cli import main
from mrgs.data.load import load_scene
from mrgs.errors import MrgsWarning, RunError
from mrgs.run_files.checkpoint import load_facts
from mrgs.scene.capture import Capture
from mrgs.training import train
from mrgs.training.start import TrainOptions, open_training
from mrgs_thermonerf import train_thermonerf
from tests.faults.runs import GAUSSIANS, NERF

KINDS = ("gaussians", pytest.param("nerf", marks=pytest.mark.slow))
TRAIN = {"gaussians": (train, GAUSSIANS), "nerf": (train_thermonerf, NERF)}


@pytest.fixture
def scene(small_scene, tmp_path) -> Path:
    return shutil.copytree(small_scene, tmp_path / "moved")


def resume(scene: Path, folder, kind: str = "gaussians", **options) -> None:
    do_train, config = TRAIN[kind]
    do_train(scene, folder.path, config, TrainOptions(resume=True, **options))


def change_frame(scene: Path, change) -> None:
    """Change a training frame of transforms.json."""
    file = scene / "transforms.json"
    content = json.loads(file.read_text())
    change(content, next(f for f in content["frames"] if "train" in f["file_path"]))
    file.write_text(json.dumps(content))


def change_photo(scene: Path, folder: str) -> None:
    """Change one pixel of a training photo."""
    path = next(path for path in sorted((scene / folder).iterdir()) if "train" in path.name)
    with Image.open(path) as image:
        changed = image.copy()
    old = changed.getpixel((3, 3))
    changed.putpixel((3, 3), 255 - old if isinstance(old, int) else tuple(255 - v for v in old))
    changed.save(path)


def shift(content, frame):
    frame["transform_matrix"][0][3] += 1e-3


def zoom(content, frame):
    content["fl_x"] *= 1.001


CHANGES = {
    r"photos of frame_train_\d+ \(rgb\)": lambda scene: change_photo(scene, "images"),
    r"photos of frame_train_\d+ \(thermal\)": lambda scene: change_photo(scene, "thermal"),
    r"poses of frame_train_\d+ \(rgb\), frame_train_\d+ \(thermal\)": lambda scene: change_frame(
        scene, shift
    ),
    r"intrinsics of .* and 9 more": lambda scene: change_frame(scene, zoom),
}


@pytest.mark.parametrize("changed", CHANGES)
def test_what_has_changed_is_named(changed, scene, gaussians_run):
    CHANGES[changed](scene)
    newest = gaussians_run.newest_checkpoint()
    before = newest.read_bytes()
    with pytest.raises(RunError, match=rf"changed .*\({changed}\)") as caught:
        resume(scene, gaussians_run)
    assert caught.value.options == ("accept_changes",)
    assert newest.read_bytes() == before


@pytest.mark.parametrize("kind", KINDS)
def test_a_scene_that_has_only_moved_is_the_same(kind, scene, request):
    resume(scene, request.getfixturevalue(f"{kind}_run"), kind)


@pytest.mark.parametrize("kind", KINDS)
def test_accepted_changes_are_told_and_belong_to_the_run(kind, scene, request):
    folder = request.getfixturevalue(f"{kind}_run")
    folder.newest_checkpoint().unlink()
    change_photo(scene, "images")
    change_frame(scene, shift)
    with pytest.raises(RunError, match=r"photos .*poses"):
        resume(scene, folder, kind)
    with pytest.warns(MrgsWarning, match="photos .*goes on"):
        resume(scene, folder, kind, accept_changes=True)
    assert load_facts(folder.newest_checkpoint()).step == 10
    resume(scene, folder, kind)


def test_a_run_goes_on_with_the_dilation_of_accepted_cameras(scene, gaussians_run):
    gaussians_run.newest_checkpoint().unlink()
    before = load_facts(gaussians_run.newest_checkpoint()).capture
    change_frame(scene, zoom)
    with (
        pytest.warns(MrgsWarning, match="intrinsics of"),
        open_training(
            scene,
            gaussians_run.path,
            GAUSSIANS,
            options=TrainOptions(resume=True, accept_changes=True),
        ) as trainer,
    ):
        dilation = trainer.state.model.dilation
    assert dilation == GAUSSIANS.dilation_of(Capture.of(load_scene(scene)))
    assert dilation.finest_focal_px == pytest.approx(1.001**0.5 * before.finest_focal_px)


def test_rounding_of_another_machine_is_no_change(scene, gaussians_run):
    def jitter(content, frame):
        for row in frame["transform_matrix"][:3]:
            row[:] = [value * (1 + 1e-13) for value in row]

    change_frame(scene, jitter)
    resume(scene, gaussians_run)


def test_changes_that_no_state_fits_are_refused_in_any_case(scene, gaussians_run):
    change_frame(scene, lambda content, frame: content["frames"].remove(frame))
    with pytest.raises(RunError, match=r"5 training .*6"):
        resume(scene, gaussians_run, accept_changes=True)


def test_the_command_line_names_its_option(scene, gaussians_run, capsys):
    change_photo(scene, "thermal")
    command = ["train", str(scene), "--output", str(gaussians_run.path)]
    assert main([*command, "--resume"]) == 2
    assert "(--accept-changes)" in capsys.readouterr().err
    assert main([*command, "--resume", "--accept-changes"]) == 0
    assert main([*command, "--accept-changes"]) == 2
    assert "--accept-changes needs --resume" in capsys.readouterr().err
