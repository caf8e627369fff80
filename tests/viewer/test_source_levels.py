from __future__ import annotations

import threading
from dataclasses import replace

import torch

from mrgs.field import FieldConfig, RadianceField
from mrgs.rasterizer.contract import Dilation
from mrgs.render import Model, rows_in_view
from mrgs.scene import Camera, Gaussians
from mrgs.viewer.source import LEVEL_FACTOR, LevelsOfDetail
from tests.helpers.gaussians import random_gaussians

AROUND = Camera.from_fov(64, 48, 90.0).look_at((0, -8, 0), (0, 0, 0))
INSIDE = Camera.from_fov(64, 48, 1.0).look_at((0, -8, 0), (0.3, 0, 0.3))


def model(count: int, residuals: bool = False) -> Model:
    gaussians = random_gaussians(count, embedding_width=6 if residuals else 0)
    gaussians.log_scales = gaussians.log_scales - 5
    field = RadianceField(FieldConfig(residuals=residuals, embedding_width=6))
    known = torch.linspace(0, 1, count)[:, None] if residuals else None
    return Model(gaussians, field, None, temperature_residuals=known, dilation=Dilation())


def levels(whole: Model, most: int) -> LevelsOfDetail:
    found = LevelsOfDetail(whole, most)
    found.maker.join()
    return found


def test_a_small_model_is_drawn_as_it_is():
    whole = model(50)
    found = LevelsOfDetail(whole, 50)
    assert not found.maker.is_alive()
    assert found.model_for(AROUND) is whole


def test_until_the_levels_are_there_the_model_is_drawn():
    go, here = threading.Event(), threading.current_thread()

    class SlowGaussians(Gaussians):
        """Holds up whoever makes levels of them."""

        def __len__(self) -> int:
            assert threading.current_thread() is here or go.wait(60)
            return super().__len__()

    whole = model(60)
    whole = replace(whole, gaussians=SlowGaussians(**vars(whole.gaussians)))
    found = LevelsOfDetail(whole, 50)
    assert found.model_for(AROUND) is whole
    go.set()
    found.maker.join()
    assert found.model_for(AROUND) is not whole


def test_the_whole_is_drawn_from_few_and_a_part_from_more():
    whole = model(3000)
    found = levels(whole, 200)
    coarse, fine = found.model_for(AROUND), found.model_for(INSIDE)
    assert 200 / LEVEL_FACTOR <= len(coarse.gaussians) <= 200
    assert len(coarse.gaussians) < len(fine.gaussians) <= 3000
    rows = rows_in_view(fine, INSIDE)
    assert rows is not None
    assert len(rows) < 300  # an estimate: what a coarse one in view stands for may lie beside it


def test_each_level_stands_for_all():
    found = levels(model(3000), 100)
    sizes = [len(level.model.gaussians) for level in found._levels]
    assert sizes == sorted(sizes, reverse=True)
    assert [level.stands_for.sum() for level in found._levels] == sizes
    assert sizes[-1] <= 100


def test_known_residuals_are_averaged():
    found = levels(model(500, residuals=True), 60)
    coarse = found.model_for(AROUND)
    assert coarse.temperature_residuals.shape == (len(coarse.gaussians), 1)
    assert coarse.temperature_residuals.min() > 0
    assert coarse.temperature_residuals.max() < 1
