"""The rasterizer: the fused pass as the training calls it, and its stages one by one.

The stages are internals of ``mrgs.kernels.rasterize.cpu``; this is the only file of the benchmarks
that knows them.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from benchmarks.plan import Case
from benchmarks.timing import Stages, Timing
from benchmarks.workload import camera, layers_of, room
from mrgs.kernels.rasterize.cpu.blend import LayerImages, blend, blend_backward
from mrgs.kernels.rasterize.cpu.projection import GaussianArrays, project, project_backward
from mrgs.kernels.rasterize.cpu.tiles import gather_splats, nearest_first, tile_lists
from mrgs.rasterizer import Geometry, rasterize, splat
from mrgs.rasterizer.contract import Dilation
from mrgs.system.gpu import HOST

FORWARD = "forward"
FORWARD_BACKWARD = "forward + backward"


def stages(case: Case) -> Stages:
    """The seven stages of the pass, and the whole pass."""
    steps = PassInStages(*case.size)
    steps.run_all()
    timings = [
        Timing("project", lambda _: steps.project()),
        Timing("order", lambda _: steps.sort()),
        Timing("gather", lambda _: steps.gather()),
        Timing("tile lists", lambda _: steps.list_tiles()),
        Timing("blend", lambda _: steps.blend()),
        Timing("blend backward", lambda _: steps.blend_backward()),
        Timing("project backward", lambda _: steps.project_backward()),
    ]
    fused = FusedPass(*case.size)
    timings.append(Timing(FORWARD, lambda _: fused.forward()))
    timings.append(Timing(FORWARD_BACKWARD, lambda _: fused.forward_backward()))
    return Stages(timings)


class FusedPass:
    """``rasterize`` of both modalities and its gradient for every input, the gradient of each pixel
    being 1."""

    def __init__(self, count: int, width: int, height: int) -> None:
        self._scene = {name: tensor.requires_grad_() for name, tensor in room(count).items()}
        self._layers = layers_of(self._scene)
        self._projection = Dilation().projection(camera(width, height), HOST)
        self._cotangents = [torch.ones(image.shape) for image in self.forward()]

    def forward(self) -> list[Tensor]:
        """Image, depth and alpha of both modalities."""
        scene = self._scene
        geometry = Geometry(scene["means"], scene["quats"], scene["scales"])
        raster = rasterize(geometry, self._layers, self._projection)
        return [image for images in raster.blends for image in images]

    def forward_backward(self) -> tuple[Tensor, ...]:
        """The gradients of the inputs."""
        return torch.autograd.grad(self.forward(), list(self._scene.values()), self._cotangents)


class PassInStages:
    """The fused pass taken apart: each method is one stage, and keeps what the next ones read.

    Attributes:
        count, width, height: N and the image's size in pixels.
        order: the visible Gaussians, nearest first.
        lists: the tile lists.
        pair_grads: gradient moments per (tile, splat) pair.
    """

    def __init__(self, count: int, width: int, height: int) -> None:
        self.count, self.width, self.height = count, width, height
        scene = {name: tensor.numpy() for name, tensor in room(count).items()}
        opacities = np.stack([scene["opacity_rgb"], scene["opacity_thermal"]], axis=1)
        features = np.concatenate([scene["colors"], scene["temperatures"]], axis=1)
        geometry = scene["means"], scene["quats"], scene["scales"]
        self._gaussians = GaussianArrays(*geometry, opacities, features)
        seen_by = Dilation().projection(camera(width, height), HOST)
        self._projection = seen_by._replace(viewmat=seen_by.viewmat.numpy(), K=seen_by.K.numpy())
        self._offset = np.zeros((count, 2), np.float32)
        self._backgrounds = np.zeros(4, np.float32)
        size = height, width
        shapes = [((*size, channels), size, size) for channels in (3, 1)]
        self._images, self._grad_images = (
            [LayerImages(*(np.full(shape, value, np.float32) for shape in each)) for each in shapes]
            for value in (0, 1)
        )
        self._grads = GaussianArrays(*(np.empty_like(array) for array in self._gaussians))
        self._grad_offset = np.empty_like(self._offset)

    def run_all(self) -> None:
        """The whole pass, once."""
        self.project()
        self.list_tiles_from_projection()
        self.blend()
        self.blend_backward()
        self.project_backward()

    def project(self) -> None:
        """EWA projection: one record per Gaussian."""
        self._records = np.empty((self.count, splat.SPLAT_FLOATS), np.float32)
        self._radii = np.empty(self.count, np.float32)
        project(self._gaussians, self._projection, self._offset, self._records, self._radii)

    def sort(self) -> None:
        """The visible Gaussians, nearest first."""
        self.order = nearest_first(
            np.ascontiguousarray(self._records[:, splat.DISTANCE]), self._radii > 0
        )

    def gather(self) -> None:
        """The records in that order."""
        self.splats = gather_splats(self._records, self.order)

    def list_tiles(self) -> None:
        """The list of each tile."""
        self.lists = tile_lists(self.splats, self.order, self.count, self.width, self.height)

    def list_tiles_from_projection(self) -> None:
        """All that stands between the projection and the blending."""
        self.sort()
        self.gather()
        self.list_tiles()

    def blend(self) -> None:
        """The images."""
        lists = self.lists
        blend(self.splats, lists.tile_splats, lists.tile_starts, self._backgrounds, *self._images)

    def blend_backward(self) -> None:
        """The gradient moments of every pair."""
        lists = self.lists
        self.pair_grads = np.empty((lists.tile_splats.size, splat.GRAD_FLOATS), np.float32)
        blend_backward(
            self.splats,
            lists.tile_splats,
            lists.tile_starts,
            *self._images,
            *self._grad_images,
            self.pair_grads,
        )

    def project_backward(self) -> None:
        """The gradients of the Gaussians."""
        lists = self.lists
        project_backward(
            self._gaussians, self._projection, self.pair_grads, lists.pair_positions,
            lists.pair_starts, self._grads, self._grad_offset,
        )  # fmt: skip
