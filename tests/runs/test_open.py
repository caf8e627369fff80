from __future__ import annotations

import inspect
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import mrgs
from mrgs.errors import ConfigError, DeviceError, RunError, SceneError
from mrgs.evaluation import evaluate_run
from mrgs.evaluation.evaluate import evaluate
from mrgs.field import RadianceField
from mrgs.kernels.heat.residuals import residuals_on_cpu
from mrgs.render import Model
from mrgs.runs.open import Run, load_run, open_run
from mrgs.runs.registry import Method
from mrgs.scene import RGB, THERMAL, Box, Camera, Modality, Rendering
from mrgs.survey import Survey, read_survey, write_survey
from mrgs.system.operation import PLAIN_VARIABLE
from tests.helpers.runs import SMALL, trained_run

MIN_C, MAX_C = 10.0, 30.0
"""What tests/conftest.py writes as the scene's temperature bounds."""


@pytest.fixture(scope="module")
def run(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    output = tmp_path_factory.mktemp("runs") / "run"
    return load_run(trained_run(tmp_path_factory, small_scene, SMALL, output))


def test_a_run_knows_what_it_was_trained_on(run, small_scene):
    assert (run.temperature.min_c, run.temperature.max_c) == (MIN_C, MAX_C)
    assert run.config == SMALL
    assert run.facts.step == SMALL.max_steps
    scene = run.load_scene()
    assert (len(scene.train), len(scene.eval)) == (6, 2)
    assert scene.extent == run.facts.capture.extent


def test_any_camera_can_be_rendered_without_gradients(run):
    camera = run.load_scene().eval[0].images[RGB].camera.resized(64, 20)
    rendering = run.render(camera)
    assert rendering[RGB].image.shape == (20, 64, 3)
    assert rendering[THERMAL].image.shape == (20, 64, 1)
    assert not any(image.requires_grad for blend in rendering.values() for image in blend)
    assert rendering[RGB].alpha.max() > 0.1


def test_thermal_may_have_a_camera_of_its_own(run):
    camera = run.load_scene().eval[0].images[RGB].camera
    rendering = run.render({RGB: camera, THERMAL: camera.resized(20, 15)})
    assert [blend.image.shape for blend in rendering.values()] == [(30, 40, 3), (15, 20, 1)]
    alone = run.render({THERMAL: camera.resized(20, 15)})
    assert list(alone) == [THERMAL]
    torch.testing.assert_close(alone[THERMAL].image, rendering[THERMAL].image)


def test_temperatures_are_celsius(run):
    rendering = run.render(run.load_scene().eval[0].images[RGB].camera)
    expected = MIN_C + (MAX_C - MIN_C) * rendering[THERMAL].image[..., 0]
    torch.testing.assert_close(run.temperatures_c(rendering, min_alpha=0), expected)
    covered = rendering[THERMAL].alpha >= 0.5
    celsius = run.temperatures_c(rendering)
    assert 0 < covered.float().mean() < 1
    torch.testing.assert_close(celsius[covered], expected[covered])
    assert celsius[~covered].isnan().all()


def test_what_the_model_does_not_show_has_no_temperature(run):
    away = Camera.from_fov(8, 6, fov_deg=50).look_at([3, 0, 1], target=[9, 0, 1])
    assert run.temperatures_c(run.render(away)).isnan().all()


def test_without_a_temperature_range_there_is_no_celsius(run):
    rendering = run.render(run.load_scene().eval[0].images[RGB].camera)
    unknown = replace(run, facts=run.facts._replace(temperature=None))
    for case, image in ((unknown, rendering), (run, Rendering({RGB: rendering[RGB]}))):
        with pytest.raises(ValueError, match="no °C"):
            case.temperatures_c(image)


def test_what_is_not_a_run_is_named(tmp_path):
    with pytest.raises(RunError, match=r"config\.yaml"):
        load_run(tmp_path)


def test_a_scene_that_has_gone_is_named(run):
    moved = replace(run, facts=run.facts._replace(scene="/nowhere/balls"))
    with pytest.raises(SceneError, match="/nowhere/balls"):
        moved.load_scene()


def test_the_package_offers_the_api():
    assert mrgs.load_run is load_run
    assert all(getattr(mrgs, name) is not None for name in mrgs.__all__)
    with pytest.raises(AttributeError, match="load_ruin"):
        _ = mrgs.load_ruin


def test_another_temperature_range_is_refused(run, small_scene, tmp_path):
    scene = shutil.copytree(small_scene, tmp_path / "scene")
    assert load_run(run.folder.path, scene).load_scene().temperature == run.temperature
    (scene / "temperature_bounds.json").write_text(
        '{"absolute_min_temperature": 0, "absolute_max_temperature": 99}', encoding="utf-8"
    )
    with pytest.raises(RunError, match="temperature range"):
        load_run(run.folder.path, scene).load_scene()


class TooLarge(Model):
    """A model that does not fit into the GPU's memory."""

    def to(self, device: torch.device) -> Model:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")


def test_a_gpu_without_enough_memory_to_render_is_said(run):
    run = replace(run, model=TooLarge(**vars(run.model)))
    with pytest.raises(DeviceError, match=f"memory .* {run.gaussian_count} Gaussians.* CPU"):
        run.render(run.load_scene().eval[0].images[RGB].camera)


class Counting(Model):
    """A model that counts how often its median depth is found."""

    found = 0

    def median_depth(self, modality: Modality, camera: Camera) -> torch.Tensor:
        Counting.found += 1
        return super().median_depth(modality, camera)


def test_scores_of_images_need_no_median_depth(run):
    run = replace(run, model=Counting(**vars(run.model)))
    scene = run.load_scene()
    evaluate(scene.eval, run.render_view, scene.temperature, camera_response=run.camera_response)
    assert Counting.found == 0
    rendering = run.render_view(scene.eval[0])
    surface = rendering.surface_depth(THERMAL)
    assert Counting.found == 1
    expected = run.model.median_depth(THERMAL, scene.eval[0].cameras[THERMAL])
    covered = rendering[THERMAL].alpha >= 0.5
    assert torch.equal(surface[covered], expected[covered])


def test_a_gpu_that_cannot_be_used_is_said(run):
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    for opened in (load_run, open_run):
        with pytest.raises(DeviceError, match="use the CPU"):
            opened(run.folder.path, device="cuda")


@pytest.mark.gpu
def test_a_gpu_renders_what_the_cpu_does_into_the_hosts_memory(run):
    on_gpu = load_run(run.folder.path, device="cuda")
    view = run.load_scene().eval[0]
    on_cpu, rendering = run.render_view(view), on_gpu.render_view(view)
    for modality, blend in rendering.items():
        for found, expected in zip(blend, on_cpu[modality], strict=True):
            assert found.device.type == "cpu"
            assert (found - expected).abs().max() < 1e-3
    assert on_gpu.model.gaussians.means.device.type == "cpu"
    observed = on_gpu.camera_response(rendering, view.camera)
    assert observed[THERMAL].image.isfinite().all()


def require_same_scores(found, expected):
    assert found.mean.keys() == expected.mean.keys() == {RGB, THERMAL}
    for modality, figures in expected.mean.items():
        numbers = {name: value for name, value in figures.items() if isinstance(value, float)}
        assert "psnr" in numbers
        same = {name: found.mean[modality][name] for name in numbers}
        assert same == pytest.approx(numbers, rel=1e-3, abs=1e-4)


@pytest.mark.gpu
def test_a_gpu_gives_the_same_scores(run):
    require_same_scores(evaluate_run(load_run(run.folder.path, device="cuda")), evaluate_run(run))


def test_without_kernels_an_opened_run_has_the_same_scores(run, monkeypatch):
    metrics = evaluate_run(run)
    monkeypatch.setenv(PLAIN_VARIABLE, "1")
    require_same_scores(evaluate_run(load_run(run.folder.path)), metrics)


@pytest.mark.compares_kernels
def test_opening_a_run_does_not_take_back_what_a_training_found_of_gradients(run):
    heat = vars(RadianceField)["temperature_residuals"]
    heat.rejected.add(residuals_on_cpu)
    try:
        load_run(run.folder.path)
        assert heat.rejected == {residuals_on_cpu}
    finally:
        heat.rejected.clear()


CAMERA = Camera.from_fov(8, 6, fov_deg=50)


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        ([CAMERA], "not list"),
        ({"rgb": CAMERA}, "'rgb'"),
        ({RGB: CAMERA.viewmat}, "rgb must have a Camera"),
    ],
)
def test_what_is_no_camera_is_named(cameras, message, run):
    with pytest.raises(ValueError, match=message):
        run.render(cameras)


@pytest.mark.parametrize(
    "attribute", [Run.modalities, Run.gaussian_count, Method.train, Method.open, Method.read_config]
)
def test_help_has_a_text(attribute):
    assert inspect.getdoc(attribute)


def test_what_is_no_scene_is_named(run):
    with pytest.raises(SceneError, match="not list"):
        load_run(run.folder.path, [])


def test_a_cropped_run_shows_what_is_in_the_box_as_before(run):
    means = run.model.gaussians.means
    low, high = means.amin(dim=0), means.median(dim=0).values
    box = Box.between(*low.tolist(), *high.tolist())
    inside = ((means >= low) & (means <= high)).all(dim=1)
    cropped = run.cropped(box)
    assert (cropped.crop, cropped.left_out) == (box, len(means) - int(inside.sum()))
    assert 0 < cropped.gaussian_count == int(inside.sum()) < run.gaussian_count
    camera = run.load_scene().eval[0].images[RGB].camera
    for modality in (RGB, THERMAL):
        values = [each.model.values(modality, camera.position.float()) for each in (run, cropped)]
        torch.testing.assert_close(values[1], values[0][inside])
    assert cropped.render(camera)[RGB].alpha.sum() < run.render(camera)[RGB].alpha.sum()


def test_the_box_of_the_survey_counts_where_none_is_given(run, tmp_path):
    own = replace(run, folder=type(run.folder)(tmp_path))
    assert own.cropped() is own
    write_survey(tmp_path / "survey.yaml", Survey(crop=(-9, -9, -9, 9, 9, 9)))
    assert own.cropped().crop == Box((-9, -9, -9), (9, 9, 9))
    assert own.cropped(Box((-8, -8, -8), (8, 8, 8))).crop.high == (8, 8, 8)
    write_survey(tmp_path / "survey.yaml", Survey(crop=(90, 90, 90, 91, 91, 91)))
    with pytest.raises(ConfigError, match=re.escape(str(tmp_path / "survey.yaml"))):
        own.cropped()


def test_a_run_that_is_cropped_twice_has_what_is_in_both_boxes(run):
    first = run.cropped(Box((-9, -9, 0), (9, 9, 9)))
    twice = first.cropped(Box((0, -9, -9), (8, 9, 9)))
    assert twice.crop == Box((0, -9, 0), (8, 9, 9))
    assert twice.gaussian_count == int(twice.crop.contains(run.model.gaussians.means).sum())
    assert twice.left_out == run.gaussian_count - twice.gaussian_count


def test_a_box_beside_the_model_is_refused_with_where_the_model_is(run):
    low = [f"{each:.6g}" for each in run.model.gaussians.means.quantile(0.02, dim=0).tolist()]
    with pytest.raises(ConfigError, match="crop") as refused:
        run.cropped(Box((90, 90, 90), (91, 91, 91)))
    assert " ".join(low)[:5] in str(refused.value)


def half(run: Run) -> Box:
    """What is within an outline around the Gaussians with x below 0."""
    (x0, y0, z0), (_, y1, z1) = run.model.gaussians.means.aminmax(dim=0)
    corners = [(x0 - 1, y0 - 1), (0.0, y0 - 1), (0.0, y1 + 1), (x0 - 1, y1 + 1)]
    return Box.around([[(float(x), float(y)) for x, y in corners]], float(z0), float(z1))


def test_what_is_kept_is_in_the_survey_until_it_is_undone(run, tmp_path):
    own = replace(run, folder=type(run.folder)(tmp_path))
    write_survey(tmp_path / "survey.yaml", Survey(client="Town"))
    box = half(run)
    own.keep(box)
    cropped = own.cropped()
    assert cropped.crop == box
    assert 0 < cropped.gaussian_count == int((run.model.gaussians.means[:, 0] < 0).sum())
    with pytest.raises(ConfigError, match="no Gaussian"):
        own.keep(Box((90, 90, 90), (91, 91, 91)))
    assert own.cropped().crop == box
    own.keep(None)
    assert own.cropped() is own
    own.undo_keep()
    assert own.cropped().crop == box
    own.undo_keep()
    assert read_survey(tmp_path / "survey.yaml") == Survey(client="Town")
    with pytest.raises(ConfigError, match="nothing to undo"):
        own.undo_keep()


def test_outlines_alone_are_as_high_as_the_model(run, tmp_path):
    own = replace(run, folder=type(run.folder)(tmp_path))
    outlines = half(run).outlines
    write_survey(tmp_path / "survey.yaml", Survey(crop_outlines=outlines))
    assert own.cropped().crop == half(run)
    write_survey(tmp_path / "survey.yaml", Survey(crop_outlines=(((0, 0), (1, 1)),)))
    with pytest.raises(ConfigError, match="3 to 200 corners"):
        own.cropped()
