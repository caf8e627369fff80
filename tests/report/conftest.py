"""The house front whose size and temperatures are known, and a small run."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mrgs.errors import ConfigError
from mrgs.field import FieldConfig, RadianceField
from mrgs.field.spherical_harmonics import C0
from mrgs.rasterizer.contract import Dilation
from mrgs.render import Model
from mrgs.report.copies import require_weasyprint
from mrgs.runs.open import Run, load_run
from mrgs.scene import RGB, THERMAL, Gaussians, Pixels, PosedImage, Scene
from tests.helpers.changed_views import with_image
from tests.helpers.runs import SMALL, trained_run
from tests.maps.conftest import front, front_scene

__all__ = ["front", "front_scene"]


@pytest.fixture(scope="session")
def pango() -> None:
    """Skips what this system cannot make a PDF for."""
    try:
        require_weasyprint()
    except ConfigError as error:
        pytest.skip(str(error))


SPLATS, RADIUS = 600, 0.8
PLACES = ((0.0, 0.4), (math.pi / 2, -0.4), (5 * math.pi / 4, 0.35))
"""Two hot places on the globe and a cold one, each before a camera: their azimuths, and by how much
they differ from what is around them."""


def globe() -> Model:
    """A ball about the origin, with a surface and temperatures that 60 steps do not give."""
    index = torch.arange(SPLATS) + 0.5
    polar, around = torch.acos(1 - 2 * index / SPLATS), torch.pi * (1 + 5**0.5) * index
    ring = polar.sin()
    outward = torch.stack([ring * around.cos(), ring * around.sin(), polar.cos()], dim=1)
    temperatures = torch.zeros(SPLATS)
    for azimuth, height in PLACES:
        up = 0.35
        place = [math.cos(up) * math.cos(azimuth), math.cos(up) * math.sin(azimuth), math.sin(up)]
        squared = (outward - torch.tensor(place)).square().sum(dim=1)
        temperatures += height * torch.exp(-0.5 * squared / 0.35**2)
    field = RadianceField(FieldConfig(residuals=False))
    gaussians = Gaussians(
        means=RADIUS * outward,
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(SPLATS, 1),
        log_scales=torch.full((SPLATS, 3), math.log(0.1 * RADIUS)),
        opacity_logits={each: torch.full((SPLATS, 1), 4.0) for each in (RGB, THERMAL)},
        sh_dc={RGB: torch.full((SPLATS, 1, 3), 0.5), THERMAL: (temperatures / C0)[:, None, None]},
        sh_rest={RGB: torch.zeros(SPLATS, 15, 3), THERMAL: torch.zeros(SPLATS, 0, 1)},
        embedding=field.initial_embedding(outward),
    )
    return Model(gaussians, field, None, sh_degree=0, dilation=Dilation())


@pytest.fixture(scope="module")
def trained(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("runs") / "run"
    return trained_run(tmp_path_factory, small_scene, SMALL, output)


@pytest.fixture(scope="module")
def opened(trained: Path) -> Run:
    """The run, showing the globe; nothing is written into its folder but by ``run``'s tests."""
    return replace(load_run(trained), model=globe())


@pytest.fixture
def run(opened: Run) -> Run:
    """The same, without what a test before left in its folder."""
    folder = opened.folder.path
    for path in (*folder.glob("*marks*"), *folder.glob("survey.yaml")):
        path.unlink()
    for path in (folder / "eval").glob("*"):
        path.unlink()
    (folder / "eval").mkdir(exist_ok=True)
    return opened


@pytest.fixture(scope="module")
def sharp(opened: Run) -> Scene:
    """The scene with finer thermal photos that show what the model does, so that temperatures are
    known well."""

    def finer(image: PosedImage) -> PosedImage:
        camera = image.camera.resized(80, 60)
        pixels = Pixels(opened.render({THERMAL: camera})[THERMAL].image)
        return replace(image, camera=camera, load=lambda: pixels, load_at_least=None, files=())

    scene = opened.load_scene()
    train, held_out = (
        tuple(with_image(view, THERMAL, finer) for view in views)
        for views in (scene.train, scene.eval)
    )
    return replace(scene, train=train, eval=held_out)
