"""LPIPS with VGG-16 (Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual
Metric", 2018).

The weights are not part of this package. ``Lpips.from_file`` reads a safetensors file, which
``Lpips.found`` looks for among the checkpoints of torch's hub (docs/runs.md), with

- ``features.N.weight`` and ``features.N.bias``, N = 0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28:
  the convolutions of VGG-16 trained on ImageNet, named and shaped as in torchvision's state dict of
  ``vgg16`` (other entries are ignored);
- ``lin0.model.1.weight`` to ``lin4.model.1.weight``, each [1, C, 1, 1]: LPIPS's linear heads
  (version 0.1) for VGG, as in the state dict of the lpips package.
"""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.nn import functional

from mrgs.errors import RunError, warn_user
from mrgs.system.torch_modes import own_modes

_BLOCKS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
"""Indices of the convolutions in VGG-16's ``features``; a max pooling stands between blocks, and
each block's last ReLU is one of LPIPS's five layers."""

_WIDTHS = (64, 128, 256, 512, 512)
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
KEPT_AS = "mrgs_lpips_vgg16.safetensors"
"""Name of the weights among the checkpoints of torch's hub."""

MIN_SIDE_PX = 16
"""Smallest image side: VGG-16 halves the image four times before the last layer."""


class Lpips:
    """The distance between two images; 0 for identical ones, about 0.1 to 0.5 for renderings. The
    network runs where the images are."""

    def __init__(self, weights: dict[str, Tensor]) -> None:
        self._weights = weights

    @classmethod
    def found(cls, path: Path | None) -> Lpips | None:
        """LPIPS with the weights of a file, or if that is None with those among the checkpoints of
        torch's hub; None if there are none, or with a warning if these cannot be used, as nobody
        asked for them. RunError as for ``from_file`` for the file."""
        if path is not None:
            return cls.from_file(path)
        kept = Path(torch.hub.get_dir(), "checkpoints", KEPT_AS)
        try:
            return cls.from_file(kept) if kept.is_file() else None
        except RunError as error:
            warn_user(f"LPIPS is left out: {error}; delete it, or convert it again (docs/runs.md)")
            return None

    @classmethod
    def from_file(cls, path: Path) -> Lpips:
        """Read the weights (names and shapes: see the module). RunError if the file is missing, is
        no safetensors file, or lacks a tensor of the right shape."""
        if not path.is_file():
            raise RunError(
                f"{path}: no such file; give a safetensors file with VGG-16 and LPIPS weights",
                options=("lpips_weights",),
            )
        shapes = weight_shapes()
        try:
            with safe_open(path, framework="pt") as file:
                weights = {
                    name: file.get_tensor(name).float() for name in set(file.keys()) & shapes.keys()
                }
        except (SafetensorError, OSError) as error:
            raise RunError(f"{path}: not a readable safetensors file ({error})") from error
        for name, shape in shapes.items():
            if name not in weights or tuple(weights[name].shape) != shape:
                found = f"is {list(weights[name].shape)}" if name in weights else "is missing"
                raise RunError(
                    f"{path}: the tensor {name} {found}; expected is {list(shape)}, see "
                    f"mrgs.evaluation.lpips"
                )
        return cls(weights)

    @torch.no_grad()
    def __call__(self, image: Float[Tensor, "h w c"], target: Float[Tensor, "h w c"]) -> float:
        """Distance of two images in [0, 1] (mapped to [-1, 1] here); one channel is shown to VGG as
        grey. No side may be shorter than ``MIN_SIDE_PX``."""
        distance = 0.0
        with own_modes(image.device):  # full precision on a GPU too
            pairs = zip(self.features(image), self.features(target), strict=True)
            for layer, (one, other) in enumerate(pairs):
                difference = (_unit(one) - _unit(other)).square()
                head = self._weights[f"lin{layer}.model.1.weight"]
                distance += functional.conv2d(difference, head).mean().item()
        return distance

    def features(self, image: Float[Tensor, "h w c"]) -> list[Float[Tensor, "1 _ _ _"]]:
        """The five layers' activations, [1, C, H / 2^layer, W / 2^layer]."""
        device = image.device
        if self._weights["features.0.weight"].device != device:
            self._weights = {name: each.to(device) for name, each in self._weights.items()}
        x = image.to(torch.float32).expand(-1, -1, 3).permute(2, 0, 1)[None] * 2 - 1
        shift, scale = torch.tensor([_SHIFT, _SCALE], device=device).view(2, 1, 3, 1, 1)
        x = (x - shift) / scale
        layers = []
        for block, indices in enumerate(_BLOCKS):
            x = functional.max_pool2d(x, 2) if block else x
            for index in indices:
                name, weights = f"features.{index}", self._weights
                x = functional.conv2d(
                    x, weights[f"{name}.weight"], weights[f"{name}.bias"], padding=1
                )
                x = x.relu()
            layers.append(x)
        return layers


def weight_shapes() -> dict[str, tuple[int, ...]]:
    """Names and shapes of the tensors that a weights file must have."""
    shapes: dict[str, tuple[int, ...]] = {}
    width_in = 3
    for block, (indices, width) in enumerate(zip(_BLOCKS, _WIDTHS, strict=True)):
        for index in indices:
            shapes[f"features.{index}.weight"] = (width, width_in, 3, 3)
            shapes[f"features.{index}.bias"] = (width,)
            width_in = width
        shapes[f"lin{block}.model.1.weight"] = (1, width, 1, 1)
    return shapes


def _unit(features: Tensor) -> Tensor:
    return features / (features.norm(dim=1, keepdim=True) + 1e-10)
