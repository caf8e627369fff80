from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch

from mrgs.export.page.packing import PART
from mrgs.export.page.write import PageContent, PageMark, write_page
from mrgs.marks.regions import Regions
from mrgs.rasterizer.contract import Dilation
from mrgs.runs.baked import BakedModel
from mrgs.scene import RGB, THERMAL, Camera, Modality, TemperatureRange
from mrgs.scene.radiometry import BandRadiance
from tests.helpers.browsers import chromium, collect_errors, new_page
from tests.helpers.gaussians import NEAR_INFRARED
from tests.helpers.pages import SETTLED


def look_at_origin(angle: float, height: float = 0.8, width: int = 96, rows: int = 64) -> Camera:
    """A camera at a distance of about 3; fx and fy differ, and the axis misses the image's
    centre."""
    position = torch.tensor(
        [2.8 * math.cos(angle), 2.8 * math.sin(angle), height], dtype=torch.float64
    )
    forward = -position / position.norm()
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    right = right / right.norm()
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    K = torch.tensor([[110.0, 0, 46.0], [0, 104.0, 33.5], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, viewmat, 96, 64).resized(width, rows)


SCALE = TemperatureRange(-10.0, 90.0)


@pytest.fixture
def cameras() -> dict[str, Camera]:
    return {f"view {i}": look_at_origin(2 * math.pi * i / 5) for i in range(5)}


@pytest.fixture
def baked() -> BakedModel:
    """600 flat splats about the origin, whose colours depend much on the view."""
    rng = torch.Generator().manual_seed(3)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=rng)

    means = 0.5 * normal(600, 3)
    scales = (0.6 * normal(600, 3) - 2.6).exp()
    opacity = (1.5 * normal(600, 2)).sigmoid()
    sh = torch.cat([0.8 * normal(600, 1, 3), 0.15 * normal(600, 15, 3)], dim=1)
    temperatures = 0.5 + 0.3 * means[:, 0].clamp(-1, 1) + 0.05 * normal(600)
    quats = torch.nn.functional.normalize(normal(600, 4), dim=1)
    return BakedModel(
        means,
        quats,
        scales,
        {RGB: opacity[:, 0], THERMAL: opacity[:, 1]},
        {RGB: sh[:, :1]},
        {RGB: sh[:, 1:]},
        temperatures,
        SCALE,
        dilation=Dilation(0.1, 107.0),
        radiance=BandRadiance.of(SCALE),
    )


@pytest.fixture
def with_nir(baked: BakedModel) -> BakedModel:
    """The same splats with near-infrared intensities, which depend on the view, and opacities."""
    rng = torch.Generator().manual_seed(4)
    base, rest = torch.randn(600, 1, 1, generator=rng), torch.randn(600, 15, 1, generator=rng)
    opacity = torch.randn(600, generator=rng).sigmoid()
    return replace(
        baked,
        opacities={**baked.opacities, NEAR_INFRARED: opacity},
        sh_dc={**baked.sh_dc, NEAR_INFRARED: 0.5 * base},
        sh_rest={**baked.sh_rest, NEAR_INFRARED: 0.15 * rest},
    )


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


@pytest.fixture
def open_page(browser, baked, cameras, tmp_path) -> Iterator[Any]:
    """Opens the page with the network off; whatever the page reports as an error fails the test."""
    path = tmp_path / "page.html"
    errors: list[str] = []
    contexts = []

    def open_it(
        shown: BakedModel = baked,
        *,
        modalities: tuple[Modality, ...] = (RGB, THERMAL),
        marks: Sequence[PageMark] = (),
        regions: Regions | None = None,
        part_size: int = PART,
        thermal_cameras: Sequence[Camera] = (),
        **options: Any,
    ) -> Any:
        content = PageContent(
            range_c=(0.0, 80.0), modalities=modalities, marks=marks, regions=regions,
            part_size=part_size, thermal_cameras=thermal_cameras,
        )  # fmt: skip
        write_page(shown, cameras, "Synthetic splats", path, content)
        page = new_page(browser, offline=True, **options)
        contexts.append(page.context)
        collect_errors(page, errors, ("file", "blob"))
        page.goto(path.as_uri())
        page.wait_for_selector(SETTLED)
        return page

    yield open_it
    for context in contexts:
        context.close()
    assert errors == []
