from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest
import torch

from mrgs.errors import SceneError
from mrgs.evaluation.evaluate import NO_CELSIUS, NO_LPIPS, Truth, evaluate
from mrgs.evaluation.lpips import Lpips
from mrgs.evaluation.metrics import Foreground, Missing, figure_names, otsu_threshold
from mrgs.pictures.files import write_float_tiff
from mrgs.scene import RGB, THERMAL, Camera, Pixels, PosedImage, Rendering, View
from tests.helpers.gaussians import NEAR_INFRARED
from tests.helpers.views import CELSIUS, ramp_view, render_with_error, rendering_of


class ConstantLpips(Lpips):
    """Stands in for the network."""

    def __init__(self) -> None:
        super().__init__({})

    def __call__(self, image: torch.Tensor, target: torch.Tensor) -> float:
        return (image - target).abs().mean().item()


def perfect(view: View) -> Rendering:
    return rendering_of({each: image.load().values for each, image in view.images.items()})


def test_known_errors() -> None:
    metrics = evaluate([ramp_view("a"), ramp_view("b")], render_with_error, CELSIUS)
    assert metrics.mean[RGB]["psnr"] == pytest.approx(20.0, abs=1e-3)
    assert metrics.mean[THERMAL]["psnr"] == pytest.approx(-20 * math.log10(0.05), abs=1e-3)
    assert metrics.mean[THERMAL]["mae_c"] == pytest.approx(1.0, abs=1e-5)
    assert metrics.mean[THERMAL]["mae_offset_c"] == pytest.approx(0.0, abs=1e-5)
    assert metrics.mean[THERMAL]["mae_foreground_c"] == pytest.approx(1.0, abs=1e-5)
    assert [view.name for view in metrics.views] == ["a", "b"]
    assert metrics.truth is None
    assert tuple(metrics.mean[THERMAL]) == (
        "psnr",
        "psnr_matched",
        "ssim",
        "ssim_pair_range",
        "mae_c",
        "mae_offset_c",
        "mae_foreground_c",
        "lpips",
    )
    assert tuple(metrics.mean[RGB]) == ("psnr", "psnr_matched", "ssim", "ssim_pair_range", "lpips")


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["warm", "cold"])
@pytest.mark.parametrize("away_px", [6, 2], ids=["small", "large"])
def test_the_foreground_is_the_square_in_the_middle_warm_or_cold(sign: float, away_px: int) -> None:
    pixels = torch.full((20, 30, 1), 0.5)
    square = torch.zeros(20, 30, dtype=torch.bool)
    square[away_px:-away_px, away_px:-away_px] = True
    pixels[square] += 0.4 * sign
    photo = PosedImage(ramp_view().images[THERMAL].camera, lambda: Pixels(pixels))
    view = View("cup", {THERMAL: photo})
    foreground = Foreground.find([view])
    assert foreground is not None
    assert foreground.is_warm is (sign > 0)
    assert torch.equal(foreground.of(Pixels(pixels)), square)

    def wrong_there(view: View) -> Rendering:
        return rendering_of({THERMAL: pixels + 0.1 * square[..., None]})

    metrics = evaluate([view], wrong_there, CELSIUS)
    assert metrics.mean[THERMAL]["mae_foreground_c"] == pytest.approx(2.0, abs=1e-5)
    share = square.double().mean().item()
    assert metrics.mean[THERMAL]["mae_c"] == pytest.approx(2.0 * share, abs=1e-5)


def test_the_threshold_is_averaged_over_the_photos() -> None:
    valid = torch.ones(18, 24, dtype=torch.bool)
    valid[:5] = False
    views = [ramp_view("a"), ramp_view("b", valid=valid), ramp_view("c", thermal=False)]
    each = []
    for view in views[:2]:
        pixels = view.images[THERMAL].load()
        mask = torch.ones(18, 24, dtype=torch.bool) if pixels.valid is None else pixels.valid
        each.append(otsu_threshold(pixels.values[mask][:, 0].numpy()))
    foreground = Foreground.find(views)
    assert foreground is not None
    assert foreground.threshold == pytest.approx(sum(each) / 2)


def test_masked_pixels_do_not_move_the_threshold() -> None:
    pixels, valid = torch.full((20, 30, 1), 0.5), torch.ones(20, 30, dtype=torch.bool)
    pixels[6:14, 8:22] = 0.9
    pixels[:3], valid[:3] = 30.0, False
    photo = PosedImage(ramp_view().images[THERMAL].camera, lambda: Pixels(pixels, valid))
    foreground = Foreground.find([View("cup", {THERMAL: photo})])
    assert foreground is not None
    assert 0.5 <= foreground.threshold < 0.9
    assert foreground.is_warm


def test_masked_pixels_do_not_count() -> None:
    valid = torch.ones(18, 24, dtype=torch.bool)
    valid[:, :10] = False  # cuts the warm square

    def wrong_outside(view: View) -> Rendering:
        thermal = view.images[THERMAL].load().values + 0.05
        thermal[~valid] = 9.0
        return rendering_of({THERMAL: thermal})

    metrics = evaluate([ramp_view(valid=valid)], wrong_outside, CELSIUS, ConstantLpips())
    assert metrics.mean[THERMAL]["mae_c"] == pytest.approx(1.0, abs=1e-5)
    assert metrics.mean[THERMAL]["psnr"] == pytest.approx(-20 * math.log10(0.05), abs=1e-3)
    assert metrics.mean[THERMAL]["mae_foreground_c"] == pytest.approx(1.0, abs=1e-5)
    assert metrics.mean[THERMAL]["lpips"] == pytest.approx(0.05 * 14 / 24, abs=1e-6)


def test_a_view_without_valid_pixels_has_no_figures() -> None:
    valid = torch.zeros(18, 24, dtype=torch.bool)
    metrics = evaluate([ramp_view(valid=valid)], perfect, CELSIUS)
    (figure,) = set(metrics.mean[THERMAL].values())
    assert "valid" in figure.reason


def test_missing_figures_say_why() -> None:
    metrics = evaluate([ramp_view()], render_with_error, temperature=None)
    assert (
        metrics.mean[THERMAL]["mae_c"]
        == metrics.mean[THERMAL]["mae_foreground_c"]
        == Missing(NO_CELSIUS)
    )
    assert metrics.mean[THERMAL]["lpips"] == metrics.mean[RGB]["lpips"] == Missing(NO_LPIPS)


def test_lpips_of_both_images() -> None:
    metrics = evaluate([ramp_view()], render_with_error, CELSIUS, ConstantLpips())
    assert metrics.mean[THERMAL]["lpips"] == pytest.approx(0.05, abs=1e-6)
    assert metrics.mean[RGB]["lpips"] == pytest.approx(0.1, abs=1e-2)


def test_images_too_small_for_lpips() -> None:
    photo = ramp_view().images[THERMAL]
    cut = Pixels(photo.load().values[:15])
    small = View("small", {THERMAL: PosedImage(photo.camera, lambda: cut)})
    metrics = evaluate([small], perfect, CELSIUS, ConstantLpips())
    assert "16 pixels" in metrics.mean[THERMAL]["lpips"].reason


def test_a_missing_modality() -> None:
    views = [ramp_view("both"), ramp_view("only_thermal", rgb=False)]
    metrics = evaluate(views, render_with_error, CELSIUS)
    assert isinstance(metrics.views[1].figures[RGB]["psnr"], Missing)
    assert metrics.mean[RGB]["psnr"] == metrics.views[0].figures[RGB]["psnr"]
    alone = evaluate(views[1:], render_with_error, CELSIUS)
    assert all(isinstance(figure, Missing) for figure in alone.mean[RGB].values())


def test_a_perfect_model_is_infinite() -> None:
    metrics = evaluate([ramp_view()], perfect, CELSIUS)
    assert metrics.mean[RGB]["psnr"] == math.inf
    assert metrics.mean[THERMAL]["mae_c"] == 0.0


def test_the_visitor_sees_each_view_once() -> None:
    seen = []
    views = [ramp_view("a"), ramp_view("b")]
    evaluate(
        views,
        render_with_error,
        None,
        visit=lambda view, rendering, metrics: seen.append((view, metrics.name)),
    )
    assert seen == [(views[0], "a"), (views[1], "b")]


def test_the_memory_of_each_view_is_given_back(monkeypatch) -> None:
    seen, given_back = [], []
    module = sys.modules[evaluate.__module__]
    monkeypatch.setattr(module, "give_back_freed", lambda: given_back.append(len(seen)))
    evaluate([ramp_view()] * 3, perfect, CELSIUS, visit=lambda *_: seen.append(1))
    assert given_back == [1, 2, 3]


def test_no_views_is_an_error() -> None:
    with pytest.raises(SceneError, match=r"'eval' .*eval_every="):
        evaluate([], perfect, None)


def test_a_rendering_of_another_size_is_a_mistake_of_the_program() -> None:
    with pytest.raises(ValueError, match="differ in size"):
        evaluate([ramp_view()], lambda view: rendering_of({RGB: torch.zeros(4, 4, 3)}), None)


def test_against_the_truth(tmp_path: Path) -> None:
    view = ramp_view("a")
    exact_c = CELSIUS.to_celsius(view.images[THERMAL].load().values[..., 0]).numpy() - 0.5
    write_float_tiff(
        tmp_path / "truth" / "temperature" / "a.tiff", exact_c, "temperature, degrees Celsius"
    )
    write_float_tiff(tmp_path / "truth" / "depth" / "a.tiff", exact_c * 0 + 1.6, "depth, metres")
    metrics = evaluate([view], render_with_error, CELSIUS, truth=Truth(tmp_path / "truth"))
    assert metrics.truth == {
        "mae_c": pytest.approx(1.5, abs=1e-5),
        "camera_mae_c": pytest.approx(0.5, abs=1e-5),
        "depth_median_relative_error": pytest.approx(0.25, abs=1e-6),
    }


def test_photos_are_compared_with_what_the_cameras_would_write() -> None:
    def colder(rendering: Rendering, camera: Camera) -> Rendering:
        assert camera is view.camera
        return rendering.with_images({THERMAL: rendering[THERMAL].image - 0.05})

    view, seen = ramp_view(), []
    metrics = evaluate(
        [view],
        perfect,
        CELSIUS,
        camera_response=colder,
        visit=lambda _, rendering, metrics: seen.append(rendering),
    )
    assert metrics.mean[THERMAL]["mae_c"] == pytest.approx(0.05 * CELSIUS.span_c, abs=1e-5)
    expected = colder(perfect(view), view.camera)[THERMAL].image
    assert torch.equal(seen[0][THERMAL].image, expected)


def test_a_third_modality_is_scored() -> None:
    views = [ramp_view("a", nir=True), ramp_view("b")]
    metrics = evaluate(views, render_with_error, CELSIUS, ConstantLpips())
    assert tuple(metrics.mean) == (THERMAL, RGB, NEAR_INFRARED)
    assert tuple(metrics.mean[NEAR_INFRARED]) == figure_names(NEAR_INFRARED) == figure_names(RGB)
    assert metrics.mean[NEAR_INFRARED]["psnr"] == pytest.approx(40.0, abs=1e-3)
    assert metrics.mean[NEAR_INFRARED]["lpips"] == pytest.approx(0.01, abs=1e-6)
    assert "near infrared" in metrics.views[1].figures[NEAR_INFRARED]["ssim"].reason
