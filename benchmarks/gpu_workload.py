"""The room of ``workload`` on a device, and random scenes to compare with the oracle."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from benchmarks.workload import (
    camera,
    layers_of,
    photos,
    room,
)
from mrgs.rasterizer import Geometry, Layer, Projection, Raster, rasterize, reference
from mrgs.rasterizer.contract import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from mrgs.scene import Modality, Pixels
from mrgs.system.cuda_graph import CudaGraph, ListRoom, lists_have
from mrgs.training.recorder import SPARE

MODALITIES = ("rgb", "thermal")
CHUNK_PIXELS = 2**22
"""(pixel, Gaussian) pairs looked at together for their distance to a threshold."""


class FusedPass:
    """``rasterize`` of both modalities on a device, and its gradient for every input."""

    def __init__(self, count: int, width: int, height: int, device: torch.device) -> None:
        self.scene = {
            name: tensor.to(device).requires_grad_() for name, tensor in room(count).items()
        }
        self._layers = [
            Layer(*(tensor.to(device) for tensor in layer)) for layer in layers_of(self.scene)
        ]
        seen_by = camera(width, height)
        self.width, self.height = width, height
        self.viewmat, self.K = seen_by.viewmat.to(device), seen_by.K.to(device)
        # Random, so that no gradient is left out because it is zero or the same everywhere.
        generator = torch.Generator().manual_seed(7)
        self.cotangents = [
            torch.randn(image.shape, generator=generator).to(device) for image in self.forward()
        ]

    def forward(self) -> list[Tensor]:
        """Image, depth and alpha of both modalities."""
        s = self.scene
        geometry = Geometry(s["means"], s["quats"], s["scales"])
        projection = Projection(self.viewmat, self.K, self.width, self.height)
        raster = rasterize(geometry, self._layers, projection)
        return [image for blend in raster.blends for image in blend]

    def render(self) -> list[Tensor]:
        """The same without what a backward pass needs."""
        with torch.no_grad():
            return self.forward()

    def forward_backward(self) -> tuple[Tensor, ...]:
        """The gradients of the inputs."""
        return torch.autograd.grad(self.forward(), list(self.scene.values()), self.cotangents)

    @property
    def least_bytes(self) -> int:
        """What forward and backward must move at least: inputs read and gradients written, images
        and theirs."""
        inputs = sum(tensor.nbytes for tensor in self.scene.values())
        images = sum(tensor.nbytes for tensor in self.cotangents)
        return 2 * (inputs + images)


class RecordedPass:
    """A fused pass, forward and backward, recorded as the steps of a training are.

    Args:
        fused: on a CUDA device.
    """

    def __init__(self, fused: FusedPass) -> None:
        measured = ListRoom()
        with lists_have(measured):
            fused.forward_backward()
        self._room = int(SPARE * measured.measured) + 1
        self._fused = fused
        self._gradients: tuple[Tensor, ...] = ()
        self._graph = CudaGraph(self._work, fused.viewmat.device)

    def _work(self) -> Tensor:
        room = ListRoom(self._room)
        with lists_have(room):
            self._gradients = self._fused.forward_backward()
        return room.needed()

    def forward_backward(self) -> tuple[Tensor, ...]:
        """The gradients of the inputs; overwritten by the next call."""
        self._graph.replay()
        return self._gradients


def photos_on(device: torch.device, width: int, height: int) -> dict[Modality, Pixels]:
    """The photos of ``workload.photos`` on a device."""
    on_host = photos(width, height)
    return {modality: Pixels(pixels.values.to(device)) for modality, pixels in on_host.items()}


@dataclass(frozen=True)
class RandomScene:
    """A rasterizer's arguments; ``tensors`` holds the differentiable ones by name, a layer's as
    "rgb.features"."""

    tensors: dict[str, Tensor]
    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    modalities: tuple[str, ...]

    def __str__(self) -> str:
        size = f"{len(self.tensors['means']):,} Gaussians, {self.width}×{self.height}"
        return f"{size}, {' and '.join(self.modalities)}"

    def to(self, device: torch.device, dtype: torch.dtype) -> RandomScene:
        """The same numbers as leaves that ask for a gradient."""
        tensors = {
            name: t.detach().to(device, dtype).requires_grad_() for name, t in self.tensors.items()
        }
        return replace(
            self,
            tensors=tensors,
            viewmat=self.viewmat.to(device, dtype),
            K=self.K.to(device, dtype),
        )

    def render(self, oracle: bool = False) -> Raster:
        """By the kernels of the device, or by the oracle."""
        t = self.tensors
        layers = [
            Layer(t[f"{name}.opacities"], t[f"{name}.features"], t[f"{name}.background"])
            for name in self.modalities
        ]
        chosen = reference.rasterize if oracle else rasterize
        return chosen(self._geometry, layers, self._projection, t["means2d_offset"])

    @property
    def _geometry(self) -> Geometry:
        return Geometry(*(self.tensors[name] for name in Geometry._fields))

    @property
    def _projection(self) -> Projection:
        return Projection(self.viewmat, self.K, self.width, self.height)

    def gradients(self, raster: Raster, cotangents: list[Tensor]) -> dict[str, Tensor]:
        """Of Σ cotangent · image, for every tensor that the images depend on."""
        images = [image for blend in raster.blends for image in blend]
        given = [cotangent.to(image) for cotangent, image in zip(cotangents, images, strict=True)]
        grads = torch.autograd.grad(images, list(self.tensors.values()), given, allow_unused=True)
        return {
            name: grad for name, grad in zip(self.tensors, grads, strict=True) if grad is not None
        }

    @torch.no_grad()
    def undecided(self) -> Tensor:
        """Pixels where rounding may decide whether a Gaussian counts, bool [H, W]: both results are
        right there.

        α near 1/255 or 0.999, or T near 1e-4; the margin of T is wide because 1 − α loses up to
        three digits.
        """
        t = self.tensors
        splats = reference.project(self._geometry, self._projection, t["means2d_offset"])
        pixels = reference.pixel_centres(self.width, self.height, t["means"])
        near = [
            self._undecided(reference.falloffs(chunk, splats.means2d, splats.covs2d), splats)
            for chunk in pixels.split(max(1, CHUNK_PIXELS // max(1, len(splats.depths))))
        ]
        return torch.cat(near).unflatten(0, (self.height, self.width))

    def _undecided(self, falloff: Tensor, splats: reference.Splats) -> Tensor:
        near = torch.zeros(len(falloff), dtype=torch.bool, device=falloff.device)
        for name in self.modalities:
            opacities = self.tensors[f"{name}.opacities"][splats.indices]
            alpha = opacities * falloff
            transmittance = reference.transmittances(reference.alphas(opacities, falloff))[:, 1:]
            for values, threshold, margin in (
                (alpha, ALPHA_MIN, 1e-4), (alpha, ALPHA_MAX, 1e-4), (transmittance,
                TRANSMITTANCE_MIN, 1e-2),
            ):  # fmt: skip
                near |= ((values / threshold - 1).abs() < margin).any(dim=1)
        return near


def random_scene(
    seed: int, count: int, width: int, height: int, modalities: tuple[str, ...]
) -> RandomScene:
    """Gaussians of all kinds before a rotated camera with an off-centre principal point; float32
    numbers.

    One in ten lies behind the camera, a third outside the image; from less than a pixel to more
    than the image, most of a few pixels; opacities from below 1/255 to above 0.999. Distances from
    the camera's centre differ, so that no rounding can swap two Gaussians.
    """
    rng = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=rng, dtype=torch.float64)

    size = torch.tensor([width, height], dtype=torch.float64)
    focal, centre = uniform(0.7, 1.5, 2) * width, uniform(0.35, 0.65, 2) * size
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = reference.rotation_matrices(uniform(-1, 1, 1, 4))[0]
    viewmat[:3, 3] = uniform(-2, 2, 3)
    steps = torch.randperm(count, generator=rng) + uniform(0, 0.5, count)
    distances = 1 + 5 * steps / max(count, 1)
    places = uniform(-0.1, 1.1, count, 2) * size
    rays = torch.cat([(places - centre) / focal, torch.ones(count, 1)], dim=1)
    depths = distances / rays.norm(dim=1)
    in_camera = rays * depths[:, None]
    in_camera[::10] *= -1
    extent_px = torch.exp(uniform(-1, 2, count))
    extent_px[3::50] = uniform(0.3, 1.0, len(extent_px[3::50])) * width
    tensors = {
        "means": (in_camera - viewmat[:3, 3]) @ viewmat[:3, :3],
        "quats": torch.randn(count, 4, generator=rng, dtype=torch.float64)
        * uniform(0.3, 3, count, 1),
        "scales": torch.exp(uniform(-0.8, 0.8, count, 3))
        * (extent_px * depths / focal[0])[:, None],
        "means2d_offset": uniform(-0.5, 0.5, count, 2),
    }
    for name, channels in zip(MODALITIES, (3, 1), strict=True):
        opacities = uniform(0.01, 0.99, count) / math.sqrt(max(1, count / 100))
        opacities[1::9] = uniform(0.001, 0.01, len(opacities[1::9]))
        opacities[5::90] = uniform(0.99, 0.99999, len(opacities[5::90]))
        tensors[f"{name}.opacities"] = opacities
        tensors[f"{name}.features"] = uniform(0, 1, count, channels)
        tensors[f"{name}.background"] = uniform(0, 1, channels)
    K = torch.diag(torch.cat([focal, torch.ones(1)]))
    K[:2, 2] = centre
    tensors = {name: tensor.float() for name, tensor in tensors.items()}
    return RandomScene(tensors, viewmat.float(), K.float(), width, height, modalities)
