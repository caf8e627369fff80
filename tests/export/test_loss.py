from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from mrgs.evaluation.metrics import psnr
from mrgs.export import baking_loss_db
from mrgs.render import render_view


def test_the_loss_is_the_mean_difference_to_the_photos(run, baked, scene):
    loss = baking_loss_db(run, baked, scene)
    expected = []
    for view in scene.eval:
        photo = view.rgb.load().values
        full = render_view(run.model, view).rgb
        expected.append(psnr(full, photo) - psnr(baked.render(view.rgb.camera).rgb, photo))
    assert loss.rgb_db == pytest.approx(sum(expected) / len(expected), abs=1e-4)
    assert abs(loss.rgb_db) < 0.5
    assert abs(loss.thermal_db) < 1e-3  # temperatures do not depend on the view


def test_a_worse_model_loses_more(run, baked, scene):
    grey = replace(baked, sh=torch.zeros_like(baked.sh))
    assert baking_loss_db(run, grey, scene).rgb_db > 1


def test_without_held_out_views_there_is_no_figure(run, baked, scene):
    assert baking_loss_db(run, baked, replace(scene, eval=())) == (None, None)
