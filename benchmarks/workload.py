"""The scene of all measurements: a wall of thin Gaussians with clutter before it, seen by one
camera.

Gaussians shrink as their number grows, as they do in training: each covers about as many pixels of
the wall as the others, and the wall is always closed.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from mrgs.field import RadianceField, nearest_neighbours
from mrgs.field.spherical_harmonics import C0
from mrgs.method.config import TrainConfig
from mrgs.method.losses.term import SceneScale
from mrgs.method.losses.terms import configured_terms
from mrgs.rasterizer import Layer
from mrgs.render import Model
from mrgs.scene import (
    RGB,
    THERMAL,
    Camera,
    Gaussians,
    Modality,
    Pixels,
    PosedImage,
    TemperatureRange,
    View,
)
from mrgs.scene.capture import Capture, Viewpoint
from mrgs.system.gpu import HOST
from mrgs.training.state import TrainingState

FIELD_OF_VIEW = math.radians(60)

EXTENT = 5.0
"""Stands for the scene's extent, in metres."""

TEMPERATURE = TemperatureRange(10.0, 40.0)
SCALE = SceneScale(EXTENT, TEMPERATURE)
VIEWPOINT = Viewpoint((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
CAPTURE = Capture((VIEWPOINT,), EXTENT, has_celsius=True)

STEP_IN_FORCE = 20_000
"""Steps are measured after this one: all degrees of the harmonics in use, the neighbours not
searched again."""


def room(count: int, seed: int = 0) -> dict[str, Tensor]:
    """Half the Gaussians on a wall 6 m away, half as clutter before it; positions and sizes in
    metres."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    wall = count // 2
    clutter = count - wall
    means = torch.cat(
        [
            torch.stack(
                [uniform(-4, 4, wall), uniform(-3, 3, wall), 6 + 0.05 * normal(wall)], dim=1
            ),
            torch.stack(
                [1.2 * normal(clutter), 0.9 * normal(clutter), uniform(2, 5.5, clutter)], dim=1
            ),
        ]
    )
    return {
        "means": means,
        "quats": normal(count, 4),
        "scales": 6
        / count**0.5
        * torch.exp(0.5 * normal(count, 3))
        * torch.tensor([1.0, 1.0, 0.3]),
        "opacity_rgb": uniform(0.05, 0.95, count),
        "opacity_thermal": uniform(0.05, 0.95, count),
        "colors": torch.rand(count, 3, generator=generator),
        "temperatures": torch.rand(count, 1, generator=generator),
    }


def layers_of(scene: dict[str, Tensor]) -> list[Layer]:
    """Both modalities of the room, before black."""
    return [
        Layer(scene["opacity_rgb"], scene["colors"], torch.zeros(3)),
        Layer(scene["opacity_thermal"], scene["temperatures"], torch.zeros(1)),
    ]


def camera(width: int, height: int, x: float = 0.0) -> Camera:
    """Looking along +z, so many metres to the right of the origin."""
    focal = 0.5 * width / math.tan(FIELD_OF_VIEW / 2)
    K = torch.tensor(
        [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64
    )
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3] = -x
    return Camera(K, viewmat, width, height)


def photos(width: int, height: int) -> dict[Modality, Pixels]:
    """A photo of noise of each modality; every pixel counts."""
    generator = torch.Generator().manual_seed(1)
    return {
        modality: Pixels(torch.rand(height, width, modality.channels, generator=generator))
        for modality in (RGB, THERMAL)
    }


def view(width: int, height: int, x: float = 0.0) -> View:
    """The camera with both photos, which share it."""
    shared = camera(width, height, x)

    def posed(pixels: Pixels) -> PosedImage:
        return PosedImage(shared, lambda: pixels)

    images = {modality: posed(pixels) for modality, pixels in photos(width, height).items()}
    return View("room", images)


def radiance_field(count: int, config: TrainConfig) -> RadianceField:
    """A field at its start, in the frame of the room."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        field = RadianceField(config.field)
    field.set_frame(room(count)["means"])
    return field


def gaussians(count: int, field: RadianceField, config: TrainConfig) -> Gaussians:
    """The room as a model's parameters, with small coefficients of the higher harmonics."""
    scene = room(count)
    generator = torch.Generator().manual_seed(2)
    blended = (RGB,) if config.shares_opacity else (RGB, THERMAL)
    bands = ((config.temperature_sh_degree or 0) + 1) ** 2 - 1
    return Gaussians(
        means=scene["means"],
        quats=scene["quats"],
        log_scales=scene["scales"].log(),
        opacity_logits={each: scene[f"opacity_{each}"][:, None].logit() for each in blended},
        sh_dc={
            RGB: (scene["colors"][:, None] - 0.5) / C0,
            THERMAL: (scene["temperatures"][:, None] - 0.5) / C0,
        },
        sh_rest={
            RGB: 0.1 * torch.randn(count, 15, 3, generator=generator),
            THERMAL: 0.1 * torch.randn(count, bands, 1, generator=generator),
        },
        embedding=field.initial_embedding(scene["means"]),
    )


def training_state(count: int, config: TrainConfig, device: torch.device = HOST) -> TrainingState:
    """A state amid training on a device, with its neighbours known; the same each time."""
    torch.manual_seed(4)
    field = radiance_field(count, config)
    parameters = gaussians(count, field, config)
    k = config.field.neighbours_k
    neighbours = nearest_neighbours(parameters.means, k) if k > 0 else None
    dilation = config.dilation_of(CAPTURE)
    model = Model(parameters, field, neighbours, sh_degree=3, dilation=dilation).to(device)
    terms, generator = configured_terms(config), torch.Generator().manual_seed(3)
    state = TrainingState.around(model, terms, config.densification, config, CAPTURE, generator)
    return replace(state, step=STEP_IN_FORCE)
