"""How much memory a run will need."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from mrgs.method.config import MAX_DEGREE, TrainConfig
from mrgs.scene import THERMAL, Modality, Scene
from mrgs.scene.capture import Capture, model_modalities
from mrgs.training.photos import kept_bytes, kept_limit

_FLOAT = 4
_GEOMETRY = 3 + 4 + 3
"""Centre, rotation and scales; each modality adds an opacity and its spherical harmonics."""

_PEAK_COPIES = 6
"""Parameter and two moments, before and after densification; a gradient beside them."""

_STORED_COPIES = 3
"""Parameter and two moments."""

_STATISTICS = 8
"""Floats per Gaussian of the density control."""

_WEIGHTS_BYTES = 2**20
"""Heads, image model and their moments."""

_BASE_BYTES = 450 * 2**20
"""Interpreter, torch, Numba and the compiled kernels, as measured."""

_CUDA_BYTES = 350 * 2**20
"""What a torch that is built for CUDA needs beyond that, even without a GPU: 250 MiB with 2.11 and
440 with 2.13, as measured."""

_COMPILER_BYTES = 220 * 2**20
"""What the compiler keeps in a process that compiles the kernels, as measured."""

_RASTER_FLOATS_PER_GAUSSIAN = 80
"""The projected record, and about four tiles per Gaussian with their gradient moments; the C
library keeps them when they are freed."""

_PIXEL_FLOATS = 28
"""Images and gradients per pixel."""


def estimate_bytes(
    scene: Scene, config: TrainConfig, gaussians: int, *, compiles: bool = False
) -> int:
    """Memory that a process needs to train this many Gaussians on the CPU, to about a fifth;
    ``compiles`` where it compiles the kernels, because none are saved. SceneError if the first
    photo of a modality cannot be read."""
    pixels = max(
        sum(camera.width * camera.height for camera in view.cameras.values())
        for view in scene.train
    )
    return training_bytes(
        config,
        scene.modalities,
        gaussians,
        pixels=pixels,
        photo_bytes=kept_bytes(scene),
        capture=Capture.of(scene),
        compiles=compiles,
    )


def training_bytes(
    config: TrainConfig,
    modalities: Iterable[Modality],
    gaussians: int,
    *,
    pixels: int,
    photo_bytes: int,
    capture: Capture | None = None,
    compiles: bool = False,
) -> int:
    """``estimate_bytes`` of a scene of which only this is known.

    Args:
        pixels: of all images of the largest view.
        photo_bytes: what the training photos take if all of them are kept.
        capture: of the photos; None for the most that the configuration allows.
        compiles: the process compiles the kernels.
    """
    return (
        _BASE_BYTES
        + (torch.version.cuda is not None) * _CUDA_BYTES
        + compiles * _COMPILER_BYTES
        + gaussians * gaussian_bytes(config, modalities, capture)
        + pixels * _PIXEL_FLOATS * _FLOAT
        + min(photo_bytes, kept_limit())
    )


def gaussian_bytes(
    config: TrainConfig, modalities: Iterable[Modality], capture: Capture | None
) -> int:
    """Memory of each Gaussian in a training, see ``training_bytes``."""
    field = config.field
    parameters = _parameters(config, modalities, capture)
    activations = 3 * field.hidden_width + 4 * field.neighbours_k if field.residuals else 0
    return _FLOAT * (_PEAK_COPIES * parameters + activations + _RASTER_FLOATS_PER_GAUSSIAN)


def checkpoint_bytes(config: TrainConfig, modalities: Iterable[Modality], gaussians: int) -> int:
    """Size of a checkpoint with this many Gaussians, roughly: parameters and moments."""
    neighbours = 2 * config.field.neighbours_k if config.field.residuals else 0
    floats = _STORED_COPIES * _parameters(config, modalities) + _STATISTICS + neighbours
    return gaussians * floats * _FLOAT + _WEIGHTS_BYTES


def _parameters(
    config: TrainConfig, modalities: Iterable[Modality], capture: Capture | None = None
) -> int:
    """Parameters of one Gaussian; without the capture, the most that the configuration allows."""
    temperature_degree = MAX_DEGREE if capture is None else config.temperature_sh_degree_of(capture)
    parameters = _GEOMETRY
    for modality in model_modalities(tuple(modalities)):
        degree = temperature_degree if modality == THERMAL else MAX_DEGREE
        parameters += 1 + modality.channels * (degree + 1) ** 2
    return parameters + (config.field.embedding_width if config.field.residuals else 0)
