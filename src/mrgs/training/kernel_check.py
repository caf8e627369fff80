"""The check at the start of a training: do the kernels compute what their plain definitions say?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Int64
from torch import Tensor

from mrgs.field import nearest_neighbours
from mrgs.method.config import TrainConfig
from mrgs.method.losses.term import LossContext, SceneScale
from mrgs.method.losses.terms import term_values
from mrgs.render import Model, render, rows_in_view
from mrgs.scene import THERMAL, Camera, Gaussians, Pixels, Scene, View
from mrgs.system.operation import checking
from mrgs.training.state import TrainingState

SAMPLED_GAUSSIANS = 300
WIDTH_PX = 48
INVALID = 0.05
"""Share of the pixels that the sample's masks leave out."""


def check_kernels(state: TrainingState, scene: Scene, config: TrainConfig) -> None:
    """Take the forward pass of a training step on a sample of the model, and compare each kernel
    with its plain definition: values and gradients.

    A kernel that differs is not used from then on in this process (``operation.checking``). The
    state is left as it is. The photos are random numbers, so that none has to be read.

    Args:
        state: of the training.
        scene: of the training; views that together have all modalities are taken.
        config: of the run.

    Warns:
        MrgsWarning: a kernel differs from its plain definition.
    """
    generator = torch.Generator().manual_seed(0)
    with checking(), torch.enable_grad():
        for number in _chosen(scene.train):
            view = scene.train[number]
            cameras = {
                modality: camera.with_width(WIDTH_PX) for modality, camera in view.cameras.items()
            }
            model = _sampled(state.model, config, next(iter(cameras.values())))
            degrees = {THERMAL: config.temperature_sh_degree_at(config.max_steps)}
            rendering, _ = render(model, cameras, degrees)
            photos = {
                modality: _random_photo(camera, modality.channels, generator, state.device)
                for modality, camera in cameras.items()
            }
            observed = state.image_model(rendering, number)
            scale = SceneScale(scene.extent, scene.temperature)
            context = LossContext(rendering, observed, photos, cameras, model.gaussians, scale)
            term_values(state.terms, context)


def _chosen(views: Sequence[View]) -> list[int]:
    """Few views that together have all modalities: those with most images first."""
    missing = {modality for view in views for modality in view.images}
    chosen = []
    for number in sorted(range(len(views)), key=lambda number: -len(views[number].images)):
        if missing & set(views[number].images):
            chosen.append(number)
            missing -= set(views[number].images)
    return chosen


def _sampled(model: Model, config: TrainConfig, camera: Camera) -> Model:
    """Copies of some Gaussians that the camera sees, under the model's own layers."""
    rows = _some_rows(model.gaussians, camera)
    copies = {
        name: tensor.detach().index_select(0, rows).requires_grad_()
        for name, tensor in model.gaussians.tensors().items()
    }
    gaussians = model.gaussians.with_tensors(copies)
    k = config.field.neighbours_k
    return replace(
        model,
        gaussians=gaussians,
        neighbours=nearest_neighbours(gaussians.means, k) if k > 0 else None,
        sh_degree=config.sh_degree_at(config.max_steps),
    )


def _some_rows(gaussians: Gaussians, camera: Camera) -> Int64[Tensor, " m"]:
    seen = rows_in_view(gaussians, camera)
    if seen is None or len(seen) == 0:
        seen = torch.arange(len(gaussians), device=gaussians.means.device)
    count = min(SAMPLED_GAUSSIANS, len(seen))
    return seen[torch.arange(count, device=seen.device) * len(seen) // max(count, 1)]


def _random_photo(
    camera: Camera, channels: int, generator: torch.Generator, device: torch.device
) -> Pixels:
    values = torch.rand(camera.height, camera.width, channels, generator=generator)
    valid = torch.rand(camera.height, camera.width, generator=generator) >= INVALID
    return Pixels(values.to(device), valid.to(device))
