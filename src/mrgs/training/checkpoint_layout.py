"""Which tensors a checkpoint must hold: their names, types and shapes follow from the run's
configuration. Kernels and optimizers trust them, so everything else is refused."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from mrgs.field.spherical_harmonics import MAX_DEGREE
from mrgs.method.config import TrainConfig
from mrgs.method.start.start_points import blended_apart, model_modalities
from mrgs.scene import THERMAL, Gaussians
from mrgs.training.facts import CheckpointFacts


def require_like(found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """The same names, and under each a tensor of the same type and shape.

    Args:
        found: tensors from a file.
        expected: examples, whose values do not count.

    Raises:
        ValueError: they differ; names the first tensor that does.
    """
    for name in sorted(found.keys() | expected.keys()):
        if name not in found:
            raise ValueError(f"{name} is missing")
        if name not in expected:
            raise ValueError(f"{name} is unknown")
        tensor, example = found[name], expected[name]
        if tensor.dtype != example.dtype or tensor.shape != example.shape:
            raise ValueError(
                f"{name} is {_described(tensor)} where {_described(example)} is expected"
            )


def gaussians_from(
    tensors: Mapping[str, Tensor], config: TrainConfig, facts: CheckpointFacts
) -> Gaussians:
    """The Gaussians of a checkpoint.

    Args:
        tensors: parameters by name, as ``Gaussians.tensors`` gives them.
        config: of the run.
        facts: of the checkpoint.

    Raises:
        ValueError: they are not those of a model of this configuration.
    """
    modalities = model_modalities(facts.modalities)
    means = tensors.get("means")
    if means is None or means.dim() != 2 or len(means) == 0:
        raise ValueError("there are no Gaussians")
    count = len(means)
    shapes: dict[str, tuple[int, ...]] = {
        "means": (count, 3),
        "quats": (count, 4),
        "log_scales": (count, 3),
        "embedding": (count, config.field.embedding_width if config.field.residuals else 0),
    }
    for modality in blended_apart(facts.modalities, config.shares_opacity):
        shapes[f"opacity_logit.{modality}"] = (count, 1)
    for modality in modalities:
        degree = MAX_DEGREE
        if modality == THERMAL:
            degree = config.temperature_sh_degree_of(facts.capture)
        shapes[f"sh_dc.{modality}"] = (count, 1, modality.channels)
        shapes[f"sh_rest.{modality}"] = (count, (degree + 1) ** 2 - 1, modality.channels)
    require_like(
        tensors, {name: torch.empty(shape, device="meta") for name, shape in shapes.items()}
    )
    return Gaussians.from_tensors(tensors, modalities)


def require_neighbours(neighbours: Tensor | None, count: int, k: int) -> None:
    """The neighbours must be those of ``count`` Gaussians; a field without heat exchange has none,
    any other may lack them right after a densification.

    Raises:
        ValueError: they are others.
    """
    if neighbours is None:
        return
    if k == 0:
        raise ValueError("neighbours is unknown")
    require_like(
        {"neighbours": neighbours},
        {"neighbours": torch.empty(count, k, dtype=torch.int64, device="meta")},
    )
    if not 0 <= int(neighbours.min()) <= int(neighbours.max()) < count:
        raise ValueError("neighbours names Gaussians that do not exist")


def below(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names begin with a prefix, by the rest of their names."""
    return {
        name.removeprefix(prefix): tensor
        for name, tensor in tensors.items()
        if name.startswith(prefix)
    }


def _described(tensor: Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"
