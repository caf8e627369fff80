"""A ball of many colours, and photos of it from poses that may be wrong."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from mrgs.field import FieldConfig, RadianceField
from mrgs.rasterizer.contract import Dilation
from mrgs.render import Model, render
from mrgs.scene import RGB, THERMAL, Camera, Scene
from tests.helpers.gaussians import random_gaussians

VIEWS = 24


def colored_ball(seed: int = 0) -> Model:
    """300 opaque Gaussians on a sphere, and what renders them."""
    gaussians = random_gaussians(300, bands=0, seed=seed)
    gaussians = replace(
        gaussians,
        means=1.4 * torch.nn.functional.normalize(gaussians.means, dim=1),
        log_scales=torch.full_like(gaussians.log_scales, math.log(0.12)),
        opacity_logits={
            each: torch.full_like(logit, 4.0) for each, logit in gaussians.opacity_logits.items()
        },
    )
    field = RadianceField(FieldConfig(residuals=False))
    return Model(gaussians, field, None, sh_degree=0, dilation=Dilation(0.3))


def orbit(width: int = 96, height: int = 72, views: int = VIEWS) -> list[Camera]:
    """Cameras around the ball, from above and from below in turn."""
    camera = Camera.from_fov(width, height, 35)
    angles = [2 * math.pi * number / views for number in range(views)]
    return [
        camera.look_at((5 * math.cos(a), 5 * math.sin(a), 1.5 * (-1) ** number), (0, 0, 0))
        for number, a in enumerate(angles)
    ]


def turned(camera: Camera, pixels: float, generator: torch.Generator) -> Camera:
    """The camera turned about a random axis, so that it sees everything so many pixels away."""
    x, y, _ = torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0).tolist()
    angle = pixels / camera.focal_px / math.hypot(x, y)
    turn = torch.linalg.matrix_exp(
        angle * torch.tensor([[0, 0, y], [0, 0, -x], [-y, x, 0]], dtype=torch.float64)
    )
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = turn
    return Camera(camera.K, viewmat @ camera.viewmat, camera.width, camera.height)


def photographed(wrong_px: float, width: int = 96, height: int = 72, views: int = VIEWS) -> Scene:
    """Photos of the ball, from poses that are off by so many pixels."""
    model, cameras = colored_ball(), orbit(width, height, views)
    with torch.no_grad():
        seen = [render(model, {RGB: camera, THERMAL: camera})[0] for camera in cameras]
    generator = torch.Generator().manual_seed(3)
    return Scene.from_arrays(
        [turned(camera, wrong_px, generator) for camera in cameras],
        rgb=torch.stack([each[RGB].image.clamp(0, 1) for each in seen]),
        celsius=20 + 10 * torch.stack([each[THERMAL].image[:, :, 0] for each in seen]),
        points=model.gaussians.means.detach(),
        colors=torch.full((300, 3), 0.5),
        eval_every=0,
    )
