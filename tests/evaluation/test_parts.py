"""The paper's thermal branch is alive in the presets for CPUs: knocked out, it is missed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mrgs.evaluation.evaluate import Parts, evaluate, score_parts
from mrgs.method.config import TrainConfig, make_config
from mrgs.runs.open import open_run
from mrgs.scene import THERMAL
from mrgs.training.start import train
from tests.helpers.changed_views import repainted, with_image
from tests.helpers.runs import SMALL, trained_run

SCENE = Path(__file__).parents[2] / "examples/tabletop"


def trained(config: TrainConfig, output: Path) -> tuple[Parts, float]:
    """The parts of a short training's model, and its thermal PSNR of two held-out views."""
    train(SCENE, output, config)
    run = open_run(output)
    views = run.load_scene().eval[::4]
    parts = score_parts(run, views)
    assert parts is not None
    whole = evaluate(views, run.render_view, run.temperature, camera_response=run.camera_response)
    return parts, whole.mean[THERMAL]["psnr"]


def test_a_photo_without_a_valid_pixel_is_left_out_of_the_means(
    tmp_path_factory, small_scene, tmp_path
):
    run = open_run(trained_run(tmp_path_factory, small_scene, SMALL, tmp_path / "run"))
    view = run.load_scene().eval[0]
    none = torch.zeros(view.images[THERMAL].load().values.shape[:2], dtype=torch.bool)
    masked = with_image(
        view,
        THERMAL,
        lambda image: repainted(image, lambda pixels: replace(pixels, valid=none)),
    )
    for part, figures in score_parts(run, [view]).knock_out.items():
        both = score_parts(run, [view, masked]).knock_out[part]
        assert both["thermal_psnr"] == pytest.approx(figures["thermal_psnr"])


@pytest.mark.slow
@pytest.mark.parametrize("alive", [True, False])
def test_a_dead_thermal_branch_is_noticed(tmp_path, alive):
    config = make_config("mrgs", "fast", max_steps=15, max_gaussians=1_000, resolution=64)
    if alive:  # as in a training of the preset's length
        config = replace(config, fitted_residuals=make_config("mrgs", "fast").fitted_residuals)
    else:  # as the presets had it once: t_i starts with all there is to say
        field = replace(config.field, temperature_scale=0.01)
        config = replace(config, fitted_residuals=0, field=field)
    parts, psnr = trained(config, tmp_path / "run")
    without = {part: psnr - figures["thermal_psnr"] for part, figures in parts.knock_out.items()}
    if alive:
        assert parts.spreads.temperature_residual > 0.01
        assert without["temperature_residual"] > 2
        assert without["shuffled_neighbours"] > 0.2
    else:
        assert parts.spreads.temperature_residual < 0.01
        assert abs(without["temperature_residual"]) < 0.1
        assert abs(without["shuffled_neighbours"]) < 0.1
