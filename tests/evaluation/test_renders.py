"""Another program's renderings of the balls in tests/conftest.py: the photos themselves, or the
photos made worse."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.data import load_scene
from mrgs.errors import MrgsWarning, RunError
from mrgs.evaluation import evaluate_run, render_run
from mrgs.evaluation.renders import evaluate_renders, find_renders
from mrgs.pictures.files import write_float_tiff, write_rendering
from mrgs.runs.open import load_run
from mrgs.scene import RGB, THERMAL, Rendering, View
from mrgs.training import make_config, train
from tests.helpers.gaussians import NEAR_INFRARED
from tests.helpers.scenes import write_scene
from tests.helpers.views import ramp_view, render_with_error

NAMES = ("frame_eval_00002", "frame_eval_00006")
SPAN_C = 20.0
"""From 10 °C to 30 °C."""


@pytest.fixture
def renders(small_scene: Path, tmp_path: Path) -> Path:
    """Perfect ones: copies of the photos, which have no distortion."""
    folder = tmp_path / "other program"
    for kind, source in (("rgb", "images"), ("thermal", "thermal")):
        (folder / kind).mkdir(parents=True)
        for name in NAMES:
            shutil.copy(small_scene / source / f"{name}.png", folder / kind)
    return folder


def photo(scene: Path, name: str) -> np.ndarray:
    with Image.open(scene / "thermal" / f"{name}.png") as image:
        return np.asarray(image, dtype=np.float32) / 255


def test_the_photos_themselves_are_perfect(small_scene, renders):
    metrics = evaluate_renders(small_scene, renders)
    assert metrics.mean[RGB]["psnr"] == metrics.mean[THERMAL]["psnr"] == np.inf
    assert metrics.mean[THERMAL]["mae_c"] == 0
    document = json.loads((renders / "eval" / "metrics.json").read_text())
    assert (document["method"], document["steps"], document["gaussians"]) == (
        "other program",
        None,
        None,
    )
    assert "another program" in document["reasons"]["gaussians"]
    assert (renders / "eval" / "metrics.md").is_file()
    assert (renders / "eval" / "contact_sheet.png").is_file()


def test_sixteen_bits_and_floats_in_celsius_and_normalised_say_the_same(
    small_scene, renders, tmp_path
):
    for name in NAMES:
        warmer = photo(small_scene, name) + 0.05
        sixteen = np.rint(warmer.clip(0, 1) * 65535).astype(np.uint16)
        (renders / "thermal" / f"{name}.png").unlink()
        Image.fromarray(sixteen).save(renders / "thermal" / f"{name}.png")
        write_float_tiff(
            tmp_path / "celsius" / "thermal" / f"{name}.tif",
            warmer * SPAN_C + 10,
            "degrees Celsius",
        )
        write_float_tiff(
            tmp_path / "normalised" / "thermal_normalised" / f"{name}.tiff", warmer, "normalised"
        )
    for folder in (renders, tmp_path / "celsius", tmp_path / "normalised"):
        metrics = evaluate_renders(small_scene, folder)
        assert metrics.mean[THERMAL]["mae_c"] == pytest.approx(0.05 * SPAN_C, abs=1e-3), folder


def test_a_modality_may_be_left_out(small_scene, renders):
    shutil.rmtree(renders / "rgb")
    metrics = evaluate_renders(small_scene, renders)
    assert metrics.mean[THERMAL]["psnr"] == np.inf
    assert "RGB" in metrics.mean[RGB]["psnr"].reason


def test_grey_saved_in_colour_and_jpeg_are_read(small_scene, renders):
    for name in NAMES:
        path = renders / "thermal" / f"{name}.png"
        with Image.open(path) as image:
            image.convert("RGB").save(path.with_suffix(".jpg"), quality=95)
        path.unlink()
    assert evaluate_renders(small_scene, renders).mean[THERMAL]["psnr"] > 35


def test_what_mrgs_renders_scores_as_its_run(small_scene, tmp_path):
    run = load_run(
        train(
            small_scene, tmp_path / "run", make_config("mrgs", max_steps=3, max_gaussians=100)
        ).path
    )
    folder = render_run(run, "eval")
    metrics = evaluate_renders(small_scene, folder, name="ours", output=tmp_path / "scores")
    document = json.loads((tmp_path / "scores" / "metrics.json").read_text())
    assert document["method"] == "ours"
    ours = evaluate_run(run)
    assert metrics.mean[THERMAL]["mae_c"] == pytest.approx(ours.mean[THERMAL]["mae_c"], abs=1e-4)
    assert metrics.mean[RGB]["psnr"] == pytest.approx(ours.mean[RGB]["psnr"], abs=0.05)  # 8 bits


def test_depth_is_scored_where_the_truth_is_known(renders, tmp_path):
    scene = write_scene(tmp_path / "scene")
    for name in NAMES:
        depth = np.full((30, 40), 2.0, np.float32)
        write_float_tiff(scene / "truth" / "depth" / f"{name}.tiff", depth, "depth")
        write_float_tiff(renders / "depth_thermal" / f"{name}.tiff", depth * 1.5, "depth")
    metrics = evaluate_renders(scene, renders)
    assert metrics.truth["depth_median_relative_error"] == pytest.approx(0.5)


def test_a_sky_without_depth_is_no_reason_to_refuse_the_images(renders, tmp_path):
    scene = write_scene(tmp_path / "scene")
    for name in NAMES:
        depth = np.full((30, 40), 2.0, np.float32)
        write_float_tiff(
            scene / "truth" / "depth" / f"{name}.tiff",
            np.where(np.eye(30, 40), np.inf, depth),
            "depth",
        )
        depth[0], depth[1] = np.inf, np.nan
        write_float_tiff(renders / "depth_thermal" / f"{name}.tiff", depth, "depth")
    metrics = evaluate_renders(scene, renders)
    assert metrics.truth["depth_median_relative_error"] == 0
    assert metrics.mean[THERMAL]["psnr"] == np.inf


def test_a_sky_far_away_is_drawn_as_one_without_depth(renders, tmp_path):
    scene, sheets = write_scene(tmp_path / "scene"), []
    for far in (np.inf, 1e4):
        for name in NAMES:
            depth = np.tile(np.linspace(2, 3, 40, dtype=np.float32), (30, 1))
            depth[:10] = far
            write_float_tiff(renders / "depth_thermal" / f"{name}.tiff", depth, "depth")
        evaluate_renders(scene, renders)
        with Image.open(renders / "eval" / "contact_sheet.png") as image:
            sheets.append(np.asarray(image))
    np.testing.assert_array_equal(*sheets)


def test_images_of_other_views_are_left_out_with_a_warning(small_scene, renders):
    Image.new("RGB", (4, 4)).save(renders / "rgb" / "frame_train_00000.png")
    with pytest.warns(MrgsWarning, match=r"rgb .*\(frame_train_00000\)"):
        evaluate_renders(small_scene, renders)


def resized(folder: Path) -> None:
    Image.new("RGB", (20, 10)).save(folder / "rgb" / f"{NAMES[0]}.png")


def coloured(folder: Path) -> None:
    Image.new("RGB", (40, 30), (250, 120, 10)).save(folder / "thermal" / f"{NAMES[0]}.png")


def transparent(folder: Path) -> None:
    Image.new("RGBA", (40, 30)).save(folder / "rgb" / f"{NAMES[0]}.png")


def not_finite(folder: Path) -> None:
    for name in NAMES:
        (folder / "thermal" / f"{name}.png").unlink()
        write_float_tiff(
            folder / "thermal" / f"{name}.tiff", np.full((30, 40), np.nan, np.float32), "broken"
        )


def two_images(folder: Path) -> None:
    Image.new("RGB", (40, 30)).save(folder / "rgb" / f"{NAMES[0]}.jpg")


def float_colours(folder: Path) -> None:
    for name in NAMES:
        (folder / "rgb" / f"{name}.png").unlink()
        write_float_tiff(folder / "rgb" / f"{name}.tiff", np.zeros((30, 40), np.float32), "grey")


def no_floats(folder: Path) -> None:
    (folder / "temperature_c").mkdir()
    for name in NAMES:
        Image.new("L", (40, 30)).save(folder / "temperature_c" / f"{name}.tiff")


def empty(folder: Path) -> None:
    shutil.rmtree(folder / "rgb")
    shutil.rmtree(folder / "thermal")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (resized, rf"rgb/{NAMES[0]}\.png .*20×10 .*40×30"),
        (coloured, rf"thermal/{NAMES[0]}\.png .*pseudo-coloured"),
        (transparent, rf"rgb/{NAMES[0]}\.png .*transparent"),
        (not_finite, rf"thermal/{NAMES[0]}\.tiff .*not finite"),
        (two_images, rf"rgb .*{NAMES[0]}\.jpg, {NAMES[0]}\.png"),
        (float_colours, rf"rgb/{NAMES[0]}\.tiff .*float image"),
        (no_floats, rf"temperature_c/{NAMES[0]}\.tiff .*no floats"),
        (
            lambda folder: (folder / "thermal" / f"{NAMES[1]}.png").unlink(),
            rf"thermal .*\({NAMES[1]}\)",
        ),
        (
            lambda folder: (folder / "rgb" / f"{NAMES[0]}.png").write_bytes(b"no image"),
            rf"rgb/{NAMES[0]}\.png: .*decoded",
        ),
        (empty, rf"no renderings.* \({NAMES[0]}, {NAMES[1]}\)"),
        (shutil.rmtree, r"not a folder"),
    ],
)
def test_what_cannot_be_scored_is_one_line(
    damage: Callable[[Path], object], message, small_scene, renders
):
    damage(renders)
    with pytest.raises(RunError, match=message) as error:
        evaluate_renders(small_scene, renders)
    assert "\n" not in str(error.value)
    assert not (renders / "eval").exists()


def test_celsius_for_a_scene_without_a_range(renders, tmp_path):
    scene = write_scene(tmp_path / "scene")
    (scene / "temperature_bounds.json").unlink()
    for name in NAMES:
        write_float_tiff(
            renders / "temperature_c" / f"{name}.tiff", np.zeros((30, 40), np.float32), "celsius"
        )
    assert load_scene(scene).temperature is None
    with pytest.raises(RunError, match=r"°C.* thermal_normalised/"):
        evaluate_renders(scene, renders)


def test_the_resolution_is_that_of_the_training(small_scene, renders):
    with pytest.raises(RunError, match=r"40×30 .*20×15 .*resolution"):
        evaluate_renders(small_scene, renders, resolution=20)


def test_a_third_modality_is_read_from_a_folder_of_its_name(renders, small_scene):
    scene = load_scene(small_scene)
    views = [
        replace(view, images={**view.images, NEAR_INFRARED: view.images[THERMAL]})
        for view in scene.eval
    ]
    (renders / "nir").mkdir()
    for name in NAMES:
        with Image.open(renders / "thermal" / f"{name}.png") as image:
            image.convert("RGB").save(renders / "nir" / f"{name}.png")
    found = find_renders(renders, replace(scene, eval=tuple(views)))
    rendering = found.rendering(views[0], scene.temperature)
    expected = views[0].images[THERMAL].load().values
    assert rendering[NEAR_INFRARED].image.numpy() == pytest.approx(expected.numpy(), abs=1e-6)


def test_values_of_another_modality_with_a_unit_are_read_back(small_scene, tmp_path):
    """``mrgs render`` writes them as pictures with a scale bar, and as floats, which are scored."""
    metric = replace(NEAR_INFRARED, unit="W/m²")
    infrared = ramp_view("v1", rgb=False, thermal=False, nir=True)
    view = View("v1", {metric: infrared.images[NEAR_INFRARED]})
    shown = Rendering({metric: render_with_error(infrared)[NEAR_INFRARED]})
    write_rendering(tmp_path, view, shown, None)
    assert (tmp_path / "nir" / "v1.png").is_file()
    renders = find_renders(tmp_path, replace(load_scene(small_scene), eval=(view,)))
    assert torch.equal(renders.rendering(view, None)[metric].image, shown[metric].image)
