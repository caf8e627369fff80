from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.errors import ConfigError, MrgsWarning, SceneError
from mrgs.evaluation import evaluate_run, render_run, score_run
from mrgs.evaluation.report import ScoredData
from mrgs.evaluation.score_run import PathOptions, facts_of, score_views
from mrgs.pictures.files import to_picture, to_rgb8
from mrgs.render import render
from mrgs.run_files.facts import CheckpointFacts, fingerprints
from mrgs.run_files.folder import RunFolder
from mrgs.runs.open import Run, load_run
from mrgs.runs.trained_run import TrainedRun
from mrgs.scene import RGB, THERMAL, Camera, Modality, Rendering
from mrgs.scene.camera import orbit
from mrgs.training import make_config
from tests.helpers.colored_ball import colored_ball, photographed
from tests.helpers.runs import trained_run


@pytest.fixture
def run(small_scene: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    config = make_config("mrgs", max_steps=3, max_gaussians=100)
    return load_run(trained_run(tmp_path_factory, small_scene, config, tmp_path / "run"))


class Ball(TrainedRun):
    """A run whose model is a ball of many colours."""

    modalities = (RGB, THERMAL)
    gaussian_count = 300

    def render_cameras(self, cameras: Mapping[Modality, Camera]) -> Rendering:
        with torch.no_grad():
            return render(colored_ball(), cameras)[0]


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def test_evaluating_writes_scores_and_a_sheet(run):
    seen = []
    metrics = evaluate_run(run, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 2), (2, 2)]
    folder = run.folder.path / "eval"
    document = json.loads((folder / "metrics.json").read_text())
    assert document["mean"]["thermal"]["psnr"] == pytest.approx(metrics.mean[THERMAL]["psnr"])
    assert (document["method"], document["steps"], document["gaussians"]) == (
        "mrgs",
        3,
        len(run.model.gaussians),
    )
    assert document["train_seconds"] > 0
    assert document["peak_memory_bytes"] > 2**20
    scene = run.load_scene()
    assert ScoredData.from_json(document["data"]) == ScoredData.of(scene, fingerprints(scene))
    assert pixels(folder / "contact_sheet.png").shape[1] > 1000
    assert "PSNR" in (folder / "metrics.md").read_text()


def test_where_poses_are_wrong_there_are_scores_with_aligned_ones(tmp_path):
    photos = photographed(wrong_px=3.0, views=6)
    scene = replace(photos, eval=photos.train)
    facts = CheckpointFacts.at_start(scene)
    run = Ball(RunFolder(tmp_path), make_config("mrgs"), facts, scene=scene)
    seen = []
    with pytest.warns(MrgsWarning, match=r"held-out photos .*pixels"):
        metrics = evaluate_run(run, progress=lambda done, total: seen.append((done, total)))
    assert seen[-1] == (24, 24)  # looked at, aligned, and scored twice
    assert metrics.pose_error_px == pytest.approx(3.0, rel=0.2)
    aligned = metrics.aligned.mean
    assert aligned[RGB]["psnr"] > metrics.mean[RGB]["psnr"] + 6
    poses = json.loads((tmp_path / "eval" / "metrics.json").read_text())["poses"]
    assert poses["error_px"] == metrics.pose_error_px
    assert poses["aligned"]["rgb"]["psnr"] == pytest.approx(aligned[RGB]["psnr"])
    report = (tmp_path / "eval" / "metrics.md").read_text()
    assert f"{metrics.pose_error_px:.1f} pixels" in report
    assert f"{aligned[RGB]['psnr']:.2f}" in report


def test_rendered_temperatures_are_those_of_the_model(run):
    folder = render_run(run, "eval")
    view = run.load_scene().eval[0]
    expected = run.temperatures_c(run.render_view(view), min_alpha=0).numpy()
    np.testing.assert_array_equal(pixels(folder / "temperature_c" / f"{view.name}.tiff"), expected)
    assert pixels(folder / "rgb" / f"{view.name}.png").shape == (
        view.images[RGB].camera.height,
        view.images[RGB].camera.width,
        3,
    )


@pytest.mark.parametrize("split", ["eval", "train", "path"])
def test_the_memory_of_each_rendering_is_given_back(split, run, monkeypatch):
    rendered, given_back = [], []
    monkeypatch.setattr(score_run, "give_back_freed", lambda: given_back.append(len(rendered)))
    path = PathOptions(frames=3) if split == "path" else None
    render_run(run, split, path=path, progress=lambda done, total: rendered.append(total))
    assert given_back == list(range(rendered[0]))


def test_each_modality_has_its_own_frames_along_a_path(run):
    told = []
    folder = render_run(
        run, "path", path=PathOptions(2), progress=lambda done, total: told.append((done, total))
    )
    assert told == [(1, 2), (2, 2)]  # both modalities are rendered at once
    assert sorted(path.name for path in folder.glob("*.mp4")) == ["rgb.mp4", "thermal.mp4"]
    cameras = orbit(run.load_scene().train_cameras, 2)
    for number, camera in enumerate(cameras):
        frame = pixels(folder / "rgb" / f"{number:05d}.png")
        np.testing.assert_array_equal(frame, to_rgb8(run.render(camera)[RGB].image))
        thermal = pixels(folder / "thermal" / f"{number:05d}.png")
        assert thermal.shape == frame.shape
        assert not np.array_equal(thermal, frame)


def test_a_path_has_the_width_and_the_scale_bar_that_are_asked_for(run):
    folder = render_run(run, "path", path=PathOptions(2, width=24, fps=5, scale_bar=True))
    frame, thermal = (pixels(folder / name / "00001.png") for name in ("rgb", "thermal"))
    assert frame.shape[1] == 24
    assert thermal.shape[0] == frame.shape[0]
    assert thermal.shape[1] > 24
    camera = orbit(run.load_scene().train_cameras, 2)[1].with_width(24)
    shown = to_picture(THERMAL, run.render(camera)[THERMAL].image, run.temperature, "inferno")
    np.testing.assert_array_equal(thermal[:, :24], shown)
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    _, seconds = imageio_ffmpeg.count_frames_and_secs(str(folder / "thermal.mp4"))
    assert seconds == pytest.approx(2 / 5)


def test_options_of_a_path_are_for_paths(run):
    with pytest.raises(ConfigError, match="choose the split path"):
        render_run(run, "eval", path=PathOptions(2))
    with pytest.raises(ConfigError, match="fps must be 1 to 240, not 0") as caught:
        PathOptions(fps=0)
    assert caught.value.options == ("fps",)


def test_a_scene_without_held_out_views_cannot_be_scored(run, tmp_path):
    scene = replace(run.load_scene(), eval=())
    with pytest.raises(SceneError, match="held out"):
        score_views(scene, None, run.render_view, facts_of(run, scene), tmp_path / "eval")
    assert not (tmp_path / "eval").exists()


def test_a_scene_from_arrays_is_told_how_to_hold_views_out(run, tmp_path):
    scene = replace(run.load_scene(), eval=(), path="")
    with pytest.raises(SceneError, match="eval_every=8") as it:
        score_views(scene, None, run.render_view, facts_of(run, scene), tmp_path / "eval")
    assert "file names" not in str(it.value)


def test_an_unknown_split_is_refused_before_anything_is_written(run):
    with pytest.raises(ConfigError, match=r"'test'.* eval, train"):
        render_run(run, "test")
    assert not (run.folder.path / "renders" / "test").exists()
