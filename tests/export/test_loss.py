from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch

from mrgs.evaluation.metrics import psnr
from mrgs.export import baking_loss_db
from mrgs.runs.open import Run
from mrgs.scene import RGB, THERMAL, Pixels, Rendering, View


def test_the_loss_is_the_mean_difference_to_the_photos(run, baked, scene):
    loss = baking_loss_db(run, baked, scene)
    expected = []
    for view in scene.eval:
        photo = view.images[RGB].load().values
        full = run.render_view(view)[RGB].image
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


def test_pixels_that_are_not_valid_do_not_count(run, baked, scene):
    """A view without a valid pixel says nothing, either."""
    first, second = scene.eval[:2]

    def masked(view: View, rows: int) -> View:
        image = view.images[RGB]
        valid = torch.zeros(image.camera.height, image.camera.width, dtype=torch.bool)
        valid[:rows] = True
        values = torch.where(valid[:, :, None], image.load().values, 0.0)
        hidden = replace(image, load=lambda: Pixels(values, valid))
        return replace(view, images=view.images | {RGB: hidden})

    found = baking_loss_db(run, baked, replace(scene, eval=(masked(first, 12), masked(second, 0))))
    photo = first.images[RGB].load().values[:12]
    full = run.render_view(first)[RGB].image[:12]
    plain = baked.render(first.cameras[RGB])[RGB].image[:12]
    assert found[RGB] == pytest.approx(psnr(full, photo) - psnr(plain, photo), abs=1e-4)


class DarkRun(Run):
    """Its cameras record half of what there is."""

    def camera_response(self, rendering: Rendering, *_: object) -> Rendering:
        return Rendering({
            each: blend._replace(image=0.5 * blend.image) for each, blend in rendering.items()
        })  # fmt: skip


def test_both_models_are_compared_as_the_cameras_would_have_recorded_them(run, baked, scene):
    darker = DarkRun(**{field.name: getattr(run, field.name) for field in fields(run)})
    loss = baking_loss_db(darker, baked, replace(scene, eval=scene.eval[:1]))
    view = scene.eval[0]
    photo = view.images[RGB].load().values
    full = 0.5 * run.render_view(view)[RGB].image
    plain = 0.5 * baked.render(view.cameras[RGB])[RGB].image
    assert loss[RGB] == pytest.approx(psnr(full, photo) - psnr(plain, photo), abs=1e-4)
