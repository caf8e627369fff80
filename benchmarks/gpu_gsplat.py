"""The room through gsplat's CUDA kernels, which blend one opacity per pass: both modalities take
two passes.

``python -m benchmarks.gpu_gsplat`` builds those kernels, where gsplat was installed without them.
That takes minutes and a CUDA compiler, so that the benchmark does it in a process of its own which
it may end.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from benchmarks.gpu_workload import FusedPass

TILE_SIZE = 16


class GsplatPasses:
    """The Gaussians of a fused pass, rendered by gsplat; the gradient asked for is that of the
    fused pass."""

    def __init__(self, fused: FusedPass) -> None:
        import gsplat

        self._gsplat: Any = gsplat
        self._fused = fused
        self._camera = {"viewmats": fused.viewmat.float()[None], "Ks": fused.K.float()[None]}
        self._size = {"width": fused.width, "height": fused.height}
        s = fused.scene
        self._layers = ((s["opacity_rgb"], s["colors"]), (s["opacity_thermal"], s["temperatures"]))

    def two_passes(self) -> list[Tensor]:
        """``gsplat.rasterization`` twice, each with its own projection, lists of tiles, and
        blending."""
        s = self._fused.scene
        images: list[Tensor] = []
        for opacities, features in self._layers:
            blended, alpha, _ = self._gsplat.rasterization(
                s["means"], s["quats"], s["scales"], opacities, features, **self._camera,
                **self._size,
                packed=False, render_mode="RGB+D",
            )  # fmt: skip
            images += [blended[0, ..., :-1], blended[0, ..., -1], alpha[0, ..., 0]]
        return images

    def shared_projection(self) -> list[Tensor]:
        """One projection and one list of tiles, with the larger opacity; blended twice."""
        s = self._fused.scene
        largest = torch.maximum(self._layers[0][0], self._layers[1][0]).detach()
        radii, means2d, depths, conics, _ = self._gsplat.fully_fused_projection(
            s["means"],
            None,
            s["quats"],
            s["scales"],
            **self._camera,
            **self._size,
            opacities=largest,
        )
        tiles = [math.ceil(side / TILE_SIZE) for side in self._size.values()]
        _, keys, ids = self._gsplat.isect_tiles(means2d, radii, depths, TILE_SIZE, *tiles)
        offsets = self._gsplat.isect_offset_encode(keys, 1, *tiles)
        images: list[Tensor] = []
        for opacities, features in self._layers:
            channels = torch.cat([features, depths[0, :, None]], dim=1)[None]
            blended, alpha = self._gsplat.rasterize_to_pixels(
                means2d, conics, channels, opacities[None], *self._size.values(), TILE_SIZE,
                offsets.view(1, tiles[1], tiles[0]), ids,
            )  # fmt: skip
            images += [blended[0, ..., :-1], blended[0, ..., -1], alpha[0, ..., 0]]
        return images

    def gradients(self, render: Callable[[], list[Tensor]]) -> tuple[Tensor, ...]:
        """Those of ``FusedPass.forward_backward``, through one of the two ways above."""
        return torch.autograd.grad(
            render(), list(self._fused.scene.values()), self._fused.cotangents
        )


def build() -> str:
    """Load gsplat's kernels, compiled for this GPU alone if they must be compiled; gsplat's
    version.

    Raises:
        ImportError: gsplat or its kernels are not there.
    """
    os.environ.setdefault(
        "TORCH_CUDA_ARCH_LIST", ".".join(map(str, torch.cuda.get_device_capability()))
    )
    import gsplat
    from gsplat.cuda._backend import _C

    if _C is None:
        raise ImportError("gsplat's kernels could not be built: no CUDA compiler")
    return str(gsplat.__version__)


if __name__ == "__main__":
    build()
