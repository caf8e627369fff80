"""A small trained run, and baked models of known shape."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mrgs.field.spherical_harmonics import C0
from mrgs.rasterizer.contract import Dilation
from mrgs.runs.baked import BakedModel, bake
from mrgs.runs.open import Run, load_run
from mrgs.scene import RGB, THERMAL, Camera, Scene, TemperatureRange
from mrgs.training import make_config
from tests.helpers.runs import trained_run
from tests.helpers.training import FITTED


@pytest.fixture(scope="session")
def run(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    config = make_config("mrgs", preset="fast", max_steps=150, max_gaussians=400)
    # At full rates to the end, so that within so few steps colours come to depend on the view.
    full_rates = replace(config.optimizer, slowdown_from=1.0)
    config = replace(config, optimizer=full_rates, fitted_residuals=FITTED)
    output = tmp_path_factory.mktemp("export") / "run"
    return load_run(trained_run(tmp_path_factory, small_scene, config, output))


@pytest.fixture(scope="session")
def scene(run: Run) -> Scene:
    return run.load_scene()


@pytest.fixture(scope="session")
def baked(run: Run, scene: Scene) -> BakedModel:
    return bake(run.model, scene.train_cameras, run.temperature)


@pytest.fixture(scope="session")
def globe() -> BakedModel:
    """An opaque sphere of radius 0.5, of small splats: red and warm for z > 0, blue and cold
    below."""
    count = 6000
    index = torch.arange(count) + 0.5
    polar, around = torch.acos(1 - 2 * index / count), torch.pi * (1 + 5**0.5) * index
    ring = polar.sin()
    means = 0.5 * torch.stack([ring * around.cos(), ring * around.sin(), polar.cos()], dim=1)
    up = means[:, 2] > 0
    colors = torch.where(up[:, None], torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.9]))
    sh = torch.zeros(count, 16, 3)
    sh[:, 0] = (colors - 0.5) / C0
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    opacities = dict.fromkeys((RGB, THERMAL), torch.full((count,), 0.95))
    temperatures = torch.where(up, 0.75, 0.25)
    scales, scale = torch.full((count, 3), 0.012), TemperatureRange(10, 30)
    return BakedModel(
        means,
        quats,
        scales,
        opacities,
        {RGB: sh[:, :1]},
        {RGB: sh[:, 1:]},
        temperatures,
        scale,
        dilation=Dilation(),
    )


@pytest.fixture
def wide_scene(scene: Scene) -> Scene:
    """The cameras of the small scene with enough pixels, and some from below."""

    def views(flip: bool):
        for view in scene.train:
            camera = view.cameras[RGB].resized(160, 120)
            turn = torch.diag(
                torch.tensor([1, -1, -1, 1] if flip else [1, 1, 1, 1], dtype=torch.float64)
            )
            camera = Camera(camera.K, camera.viewmat @ turn, camera.width, camera.height)
            yield replace(view, images={RGB: replace(view.images[RGB], camera=camera)})

    return replace(scene, train=(*views(False), *views(True)))


@pytest.fixture
def globe_under_sky(globe: BakedModel, wide_scene: Scene) -> BakedModel:
    """The same sphere, and cold splats all around it where training puts what lies far behind a
    scene."""
    ball = wide_scene.reach
    return replace(
        globe.map_tensors(lambda tensor: torch.cat([tensor] * 2)),
        means=torch.cat(
            [globe.means, ball.centre.float() + 2 * ball.background_distance * globe.means]
        ),
        scales=torch.cat(
            [globe.scales, torch.full_like(globe.scales, 0.05 * ball.background_distance)]
        ),
        temperatures=torch.cat([globe.temperatures, torch.zeros_like(globe.temperatures)]),
    )
