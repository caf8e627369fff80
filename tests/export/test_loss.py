from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from mrgs.evaluation.metrics import psnr
from mrgs.export import baking_loss_db
from mrgs.render import render_view
from mrgs.scene import RGB, THERMAL


def test_the_loss_is_the_mean_difference_to_the_photos(run, baked, scene):
    loss = baking_loss_db(run, baked, scene)
    expected = []
    for view in scene.eval:
        photo = view.images[RGB].load().values
        full = render_view(run.model, view)[RGB].image
        expected.append(psnr(full, photo) - psnr(baked.render(view.cameras[RGB])[RGB].image, photo))
    assert loss[RGB] == pytest.approx(sum(expected) / len(expected), abs=1e-4)
    assert abs(loss[RGB]) < 0.5
    assert abs(loss[THERMAL]) < 1e-3  # temperatures do not depend on the view


def test_a_worse_model_loses_more(run, baked, scene):
    grey = replace(
        baked,
        sh_dc={RGB: torch.zeros_like(baked.sh_dc[RGB])},
        sh_rest={RGB: torch.zeros_like(baked.sh_rest[RGB])},
    )
    assert baking_loss_db(run, grey, scene)[RGB] > 1


def test_without_held_out_views_there_is_no_figure(run, baked, scene):
    loss = baking_loss_db(run, baked, replace(scene, eval=()))
    assert loss == {RGB: None, THERMAL: None}
