"""Every splat file, read by an independent program, must look like the model that it was written
from."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mrgs.evaluation.metrics import psnr
from mrgs.export.glb import write_glb
from mrgs.export.ply import write_splat_ply
from mrgs.export.splats import shaded_splats, thermal_scale, thermal_splats
from mrgs.export.spz import write_spz
from mrgs.scene import RGB, THERMAL
from tests.helpers.exports import draw, read_glb, splat_transform, splats_of

TOLERANCE_DB = 0.2
"""Against the photo."""

LEAST_LIKENESS_DB = 40.0
"""Against the rendering before it was written."""


@pytest.mark.parametrize(("suffix", "write"), [("ply", write_splat_ply), ("spz", write_spz)])
def test_rgb(tmp_path, baked, scene, suffix, write):
    back = splat_transform(write(tmp_path / f"rgb.{suffix}", shaded_splats(baked, RGB)))
    for view in scene.eval:
        photo, rendering = (
            view.images[RGB].load().values,
            baked.render(view.cameras[RGB])[RGB].image,
        )
        drawn = draw(back, view.cameras[RGB])
        assert psnr(rendering, photo) > 18  # a model of something
        assert abs(psnr(drawn, photo) - psnr(rendering, photo)) < TOLERANCE_DB
        assert psnr(drawn, rendering.clamp(0, 1)) > LEAST_LIKENESS_DB


@pytest.mark.parametrize(("suffix", "write"), [("ply", write_splat_ply), ("spz", write_spz)])
def test_colour_mapped_temperatures(tmp_path, baked, scene, suffix, write):
    scale = thermal_scale(baked, "iron")
    splats = thermal_splats(baked, scale)
    back = splat_transform(write(tmp_path / f"thermal.{suffix}", splats))
    for view in scene.eval:
        celsius = baked.temperature.to_celsius(view.images[THERMAL].load().values[..., 0]).numpy()
        photo = torch.from_numpy(scale.colorize(celsius) / np.float32(255))
        rendering, drawn = draw(splats, view.cameras[THERMAL]), draw(back, view.cameras[THERMAL])
        assert abs(psnr(drawn, photo) - psnr(rendering, photo)) < TOLERANCE_DB
        assert psnr(drawn, rendering.clamp(0, 1)) > LEAST_LIKENESS_DB


def test_glb(tmp_path, baked, scene):
    back = splats_of(
        read_glb(write_glb(tmp_path / "rgb.glb", shaded_splats(baked, RGB)))["attributes"]
    )
    for view in scene.eval:
        photo, rendering = (
            view.images[RGB].load().values,
            baked.render(view.cameras[RGB])[RGB].image,
        )
        drawn = draw(back, view.cameras[RGB])
        assert abs(psnr(drawn, photo) - psnr(rendering, photo)) < TOLERANCE_DB
        assert psnr(drawn, rendering.clamp(0, 1)) > LEAST_LIKENESS_DB
