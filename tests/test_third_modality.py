"""A modality is a value: near infrared, which no part of the package names, goes all the way from
a scene's files to scores, pictures and exports."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
import torch
from PIL import Image
from torch import Tensor

from mrgs import load_run, load_scene, make_config, train
from mrgs.data.ply import read_ply
from mrgs.errors import RunError
from mrgs.evaluation import evaluate_run, render_run
from mrgs.export import export
from mrgs.method.config import TrainConfig
from mrgs.runs.open import Run
from mrgs.scene import RGB, THERMAL, Modality, known_modalities
from mrgs.viewer.facts import point_text
from mrgs.viewer.inspection import Inspection
from mrgs.viewer.settings import Mode, Settings
from tests.helpers.runs import made_once, trained_run
from tests.helpers.subjects import subject_of

NIR = Modality("nir", 1)
STEPS = 30


def config(method: str = "mrgs-plus") -> TrainConfig:
    return make_config(method, "fast", max_steps=STEPS, max_gaussians=400, seed=2)


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The generated table-top, small, with near-infrared photos."""
    pytest.importorskip("mitsuba", reason="the extra synth is not installed")
    from mrgs_synth import synthesize

    sizes = {"width": 48, "height": 36, "train_views": 6, "eval_views": 2, "samples": 4}
    return made_once(
        tmp_path_factory, "near_infrared", lambda path: synthesize(path, bands=["nir"], **sizes)
    )


@pytest.fixture(scope="module")
def run(scene_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    output = tmp_path_factory.mktemp("runs") / "run"
    return load_run(trained_run(tmp_path_factory, scene_folder, config(), output))


def test_the_scenes_file_is_all_that_is_needed(scene_folder: Path) -> None:
    scene = load_scene(scene_folder)
    assert scene.modalities == (RGB, THERMAL, NIR)
    assert scene.modalities[2].title == "Near infrared"
    photo = scene.train[0].images[NIR].load()
    assert photo.values.shape == (36, 48, 1)
    assert scene.train[0].shares_camera(RGB, NIR)
    assert NIR not in known_modalities()


def test_it_is_trained_with_an_opacity_and_an_appearance_of_its_own(run: Run) -> None:
    assert run.modalities == (RGB, THERMAL, NIR)
    assert run.modalities[2].title == "Near infrared"
    gaussians = run.model.gaussians
    assert set(gaussians.opacity_logits) == {RGB, THERMAL, NIR}
    assert not torch.equal(gaussians.opacity(NIR), gaussians.opacity(RGB))
    log = [json.loads(line) for line in run.folder.log_file.read_text().splitlines()]
    losses = [entry["loss_nir"] for entry in log if "loss_nir" in entry]
    assert len(losses) > 1
    assert 0 < losses[-1] != losses[0]
    assert not torch.equal(gaussians.sh_dc[NIR], gaussians.sh_dc[THERMAL])


def test_it_is_rendered_as_it_was_photographed(run: Run) -> None:
    view = run.load_scene().train[0]
    rendering = run.render_view(view)
    photo = view.images[NIR].load().values
    both = torch.stack([rendering[NIR].image.flatten(), photo.flatten()])
    assert (both[0] - both[1]).abs().mean() < 0.2 * photo.mean()
    assert torch.corrcoef(both)[0, 1] > 0.25  # four paths per pixel leave much noise
    assert rendering[NIR].alpha.max() > 0.5
    alone = run.render({NIR: view.camera})
    assert list(alone) == [NIR]
    torch.testing.assert_close(alone[NIR].image, rendering[NIR].image)


def test_a_run_is_resumed_bit_for_bit(run: Run, scene_folder: Path, tmp_path: Path) -> None:
    half = tmp_path / "half"
    train(scene_folder, half, config(), stop_at=STEPS // 2)
    train(scene_folder, half, config(), resume=True)
    expected, found = (
        safetensors.numpy.load_file(folder.newest_checkpoint())
        for folder in (run.folder, load_run(half).folder)
    )
    assert expected.keys() == found.keys()
    assert {"gaussians.sh_dc.nir", "gaussians.opacity_logit.nir"} <= expected.keys()
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


def test_it_is_scored_and_stands_on_the_contact_sheet(run: Run) -> None:
    evaluate_run(run)
    means = json.loads((run.folder.path / "eval/metrics.json").read_text())["mean"]
    assert set(means) == {"rgb", "thermal", "nir"}
    assert means["nir"].keys() == means["rgb"].keys()
    assert means["nir"]["psnr"] > 12
    assert "## Near infrared" in (run.folder.path / "eval/metrics.md").read_text()
    assert (run.folder.path / "eval/contact_sheet.png").is_file()


def test_it_is_rendered_to_files(run: Run) -> None:
    folder = render_run(run)
    with Image.open(folder / "nir/frame_eval_00001.png") as picture:
        assert picture.size == (48, 36)
    assert (folder / "depth_nir/frame_eval_00001.tiff").is_file()


def test_it_is_shown_and_read_in_the_viewer(run: Run, tmp_path: Path) -> None:
    subject = subject_of(run, run.load_scene(), tmp_path)
    labels = {mode.label: mode for mode in subject.modes}
    assert list(labels)[:4] == ["Temperature", "Colour", "Near infrared", "Depth"]
    with_it = [label for label in labels if "Near infrared" in label]
    assert any("side by side" in label for label in with_it)
    assert any("slider" in label for label in with_it)
    camera = subject.views[0].camera.resized(96, 72)
    pictures = {}
    for label, mode in labels.items():
        inspection = Inspection(subject)
        inspection.settings = Settings(mode)
        pictures[label] = inspection.picture(camera).pixels
    infrared = pictures["Near infrared"]
    assert all(
        (infrared != other).any() for label, other in pictures.items() if other is not infrared
    )
    rendering = run.render(camera)[NIR]
    middle = infrared[36, 30:90:20]
    expected = np.rint(rendering.image[36, 30:90:20].clamp(0, 1).numpy() * 255)
    np.testing.assert_array_equal(middle, np.repeat(expected, 3, axis=1))

    inspection = Inspection(subject)
    inspection.settings = Settings(labels["Near infrared"])
    inspection.picture(camera)
    solid = int(rendering.alpha.argmax())
    row, column = divmod(solid, 96)
    shown = inspection.click((column + 0.5) / 96, (row + 0.5) / 72)
    assert shown is not None
    assert shown.modality == NIR
    assert shown.value == pytest.approx(rendering.image[row, column, 0].item(), abs=1e-4)
    assert set(shown.reading.values) == {THERMAL, NIR}
    text = point_text(shown, subject)
    assert text["value"] == f"Near infrared {shown.value:.3f}"
    assert "°C" in text["lines"][0]  # the temperature is read as well


def test_a_modality_with_a_unit_has_a_palette_and_its_unit(run: Run, tmp_path: Path) -> None:
    """Only the value of the modality is another; nothing else of the run changes."""
    metric = replace(NIR, unit="W/m²", title="Radiance")
    gaussians = run.model.gaussians

    def named(tensors: Mapping[Modality, Tensor]) -> dict[Modality, Tensor]:
        return {metric if each == NIR else each: tensor for each, tensor in tensors.items()}

    model = replace(
        run.model,
        gaussians=replace(
            gaussians,
            opacity_logits=named(gaussians.opacity_logits),
            sh_dc=named(gaussians.sh_dc),
            sh_rest=named(gaussians.sh_rest),
        ),
    )
    subject = subject_of(replace(run, model=model), None, tmp_path)
    assert subject.modalities == (THERMAL, NIR, RGB)
    inspection = Inspection(subject)
    inspection.settings = Settings(Mode("image", (metric,)), "iron")
    camera = run.load_scene().train[0].camera
    scale = inspection.picture(camera).scales[NIR]
    assert (scale.palette, scale.unit) == ("iron", "W/m²")
    row, column = divmod(int(run.render({NIR: camera})[NIR].alpha.argmax()), camera.width)
    shown = inspection.click((column + 0.5) / camera.width, (row + 0.5) / camera.height)
    assert shown is not None
    assert "W/m²" in point_text(shown, subject)["value"]


def test_it_is_offered_by_the_page(run: Run, tmp_path: Path) -> None:
    (path,) = export(run, run.load_scene(), "page", tmp_path)
    text = path.read_text(encoding="utf-8")
    assert '<button data-modality="nir"' in text
    assert '"readable": ["thermal", "nir"]' in text
    assert '"opacity_nir"' in text


def test_it_is_exported(run: Run, tmp_path: Path) -> None:
    scene = run.load_scene()
    for name in ("ply", "spz", "glb", "points", "mesh", "page", "cameras"):
        export(run, scene, name, tmp_path)
    for name in ("nir.ply", "nir.spz", "nir.glb"):
        facts = json.loads((tmp_path / f"{name}.json").read_text())
        assert (tmp_path / name).is_file()
        assert facts["nir"]["unit"] == "normalised"
        assert abs(facts["baking_loss_db"]["nir"]) < 1
    read_ply(tmp_path / "points.ply")
    exported = load_scene(tmp_path / "cameras")
    assert exported.modalities == (RGB, THERMAL, NIR)
    photos = [each.train[0].images[NIR].load().values for each in (scene, exported)]
    torch.testing.assert_close(photos[0], photos[1], atol=1e-3, rtol=0)


@pytest.mark.parametrize("method", ["3dgs-rgbt", "mrgs"])
def test_other_methods_have_it_too(method: str, scene_folder: Path, tmp_path: Path) -> None:
    train(scene_folder, tmp_path, config(method), stop_at=3)
    run = load_run(tmp_path)
    shares = method == "3dgs-rgbt"
    assert set(run.model.gaussians.opacity_logits) == ({RGB} if shares else {RGB, THERMAL, NIR})
    assert NIR in run.render_view(run.load_scene().eval[0])


def test_a_run_that_began_without_it_stays_without_it(scene_folder: Path, tmp_path: Path) -> None:
    bare = shutil.copytree(scene_folder, tmp_path / "scene")
    content = json.loads((scene_folder / "transforms.json").read_text())
    frames = [
        {key: value for key, value in frame.items() if key != "nir_file_path"}
        for frame in content["frames"]
    ]
    without = content | {"modalities": [], "frames": frames}
    (bare / "transforms.json").write_text(json.dumps(without))
    train(bare, tmp_path / "run", config(), stop_at=2)
    assert load_run(tmp_path / "run").modalities == (RGB, THERMAL)

    (bare / "transforms.json").write_text(json.dumps(content))
    evaluate_run(load_run(tmp_path / "run"))
    scores = json.loads((tmp_path / "run/eval/metrics.json").read_text())
    assert set(scores["mean"]) >= {"rgb", "thermal"}
    with pytest.raises(RunError, match="began without \\(nir\\)"):
        train(bare, tmp_path / "run", config(), resume=True)
