"""gsplat's own plain-torch reference functions on the CPU, beside the same stages here.

gsplat is made for CUDA. Of its reference, ``gsplat.cuda._torch_impl``, this much runs without a
compiler: spherical harmonics, projection, tile intersection (a Python loop over the Gaussians), and
compositing (``accumulate``) but for two things that exist for CUDA alone and are replaced here by a
few lines of torch: the list of (pixel, Gaussian) pairs, whose time is not counted, and nerfacc's
two helpers inside ``accumulate``. gsplat blends one opacity per pass, so both modalities take two
passes.

Both dilate by 0.3 px². gsplat bounds a Gaussian at 3.33 standard deviations, which no α above 1/255
exceeds. The rules that leave pairs out (α < 1/255, T < 1e-4) are applied in the list, and so are
this project's. What remains are differences of rounding, which beside a threshold decide over a
whole contribution.
"""

from __future__ import annotations

import sys
import types
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from benchmarks.plan import Case
from benchmarks.stages.rasterizer import FusedPass, PassInStages
from benchmarks.timing import SkippedError, Stages, Timing
from benchmarks.workload import camera, room
from mrgs.field.spherical_harmonics import evaluate_sh
from mrgs.rasterizer.contract import ALPHA_MAX, ALPHA_MIN, NEAR_PLANE, TRANSMITTANCE_MIN

TILE_SIZE = 16
LARGEST_FOR_TILES = 10_000
"""Beyond so many Gaussians the loop over them takes a minute, and the pairs do not fit in
memory."""


def stages(case: Case) -> Stages:
    """Harmonics and projection at every size; tiles and compositing at the smallest."""
    count = case.size[0]
    reference = GsplatReference(*case.size)
    ours = PassInStages(*case.size)
    ours.run_all()
    fused = FusedPass(*case.size)
    timings = [
        Timing("gsplat: harmonics, degree 3, forward + backward", lambda _: reference.harmonics()),
        Timing(
            "mrgs: harmonics, degree 3, forward + backward", lambda _: reference.our_harmonics()
        ),
        Timing("gsplat: projection", lambda _: reference.project()),
        Timing("mrgs: projection", lambda _: ours.project()),
    ]
    notes = {}
    if count <= LARGEST_FOR_TILES:
        notes = agreement(reference.images(), fused.forward())
        listed = " and ".join(f"{len(pixels):,}" for _, pixels in reference.pairs)
        notes["(pixel, Gaussian) pairs of the two opacities"] = listed
        timings += [
            Timing("gsplat: tile intersection, one opacity", lambda _: reference.intersect_tiles()),
            Timing("mrgs: order and tile lists", lambda _: ours.list_tiles_from_projection()),
            Timing(
                "gsplat: projection and compositing of listed pairs, two opacities, forward + "
                "backward",
                lambda _: reference.composite(),
            ),
            Timing(
                "mrgs: whole fused pass, forward + backward", lambda _: fused.forward_backward()
            ),
        ]
    return Stages(timings, notes)


def agreement(theirs: list[Tensor], ours: list[Tensor]) -> dict[str, str]:
    """Differences of the images, of which there are image, depth and alpha per modality.

    gsplat sorts by z unless told otherwise, and images in another order differ wherever Gaussians
    overlap: ``GsplatReference`` gives it the distances from the camera, by which ``mrgs`` sorts.
    """
    notes = {}
    for name, first, second in zip(
        ("rgb", "rgb depth, m", "rgb alpha"), theirs, ours, strict=False
    ):
        difference = (first - second).detach().abs()
        notes[f"difference, {name}"] = (
            f"mean {difference.mean():.1e}, largest {difference.max():.1e}"
        )
    difference = (theirs[3] - ours[3]).detach().abs()
    notes["difference, thermal"] = f"mean {difference.mean():.1e}, largest {difference.max():.1e}"
    return notes


class GsplatReference:
    """The room in gsplat's layout, and its functions applied one after the other.

    Raises:
        SkippedError: gsplat is not installed, or a release has other functions.
    """

    def __init__(self, count: int, width: int, height: int) -> None:
        self._gsplat = _import_reference()
        self._size = width, height
        self._tiles = -(-width // TILE_SIZE), -(-height // TILE_SIZE)
        self._scene = {name: tensor.requires_grad_() for name, tensor in room(count).items()}
        seen_by = camera(width, height)
        self._viewmats, self._Ks = seen_by.viewmat.float()[None], seen_by.K.float()[None]
        offsets = self._scene["means"].detach() - seen_by.position.float()
        self._distances = offsets.norm(dim=1)[None]
        self._sh = torch.randn(
            count, 16, 3, generator=torch.Generator().manual_seed(6)
        ).requires_grad_()
        self._dc, self._rest = (
            part.detach().clone().requires_grad_() for part in self._sh.split((1, 15), dim=1)
        )
        self._directions = torch.nn.functional.normalize(self._scene["means"].detach(), dim=1)
        with torch.no_grad():
            self._projected = self.project()

    def harmonics(self) -> tuple[Tensor, ...]:
        """Gradients of the coefficients."""
        return torch.autograd.grad(
            self._gsplat._spherical_harmonics(3, self._directions, self._sh).sum(), self._sh
        )

    def our_harmonics(self) -> tuple[Tensor, ...]:
        """The same with the function of ``mrgs``, which keeps degree 0 apart."""
        values = evaluate_sh(self._dc, self._rest, self._directions, 3)
        return torch.autograd.grad(values.sum(), [self._dc, self._rest])

    def project(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Radii, centres, depths and conics, for one camera."""
        scene = self._scene
        covars, _ = self._gsplat._quat_scale_to_covar_preci(
            scene["quats"], scene["scales"], compute_preci=False
        )
        radii, means2d, depths, conics, _ = self._gsplat._fully_fused_projection(
            scene["means"], covars, self._viewmats, self._Ks, *self._size, near_plane=NEAR_PLANE
        )
        return radii, means2d, depths, conics

    def intersect_tiles(self) -> tuple[Tensor, Tensor]:
        """Gaussians of all tiles, nearest first, and where each tile's begin."""
        radii, means2d, _, _ = self._projected
        found = self._gsplat._isect_tiles(means2d, radii, self._distances, TILE_SIZE, *self._tiles)
        _, keys, ids = found
        return ids, self._gsplat._isect_offset_encode(keys, 1, *self._tiles)

    @cached_property
    @torch.no_grad()
    def pairs(self) -> list[tuple[Tensor, Tensor]]:
        """Of each modality, the pairs that count: (Gaussian, pixel), sorted by pixel and then by
        distance."""
        _, means2d, _, conics = self._projected
        width, height = self._size
        gaussian, pixel = _candidates(*self.intersect_tiles(), width, height)
        delta = torch.stack([pixel % width, pixel // width], dim=1) + 0.5 - means2d[0, gaussian]
        a, b, c = conics[0, gaussian].unbind(dim=1)
        falloff = torch.exp(
            -0.5 * (a * delta[:, 0] ** 2 + c * delta[:, 1] ** 2) - b * delta[:, 0] * delta[:, 1]
        )
        pairs = []
        for opacity in (self._scene["opacity_rgb"], self._scene["opacity_thermal"]):
            alpha = (opacity[gaussian] * falloff).clamp_max(ALPHA_MAX)
            seen = (alpha >= ALPHA_MIN).nonzero()[:, 0]
            before = transmittance_before(alpha[seen], pixel[seen], width * height)
            seen = seen[before >= TRANSMITTANCE_MIN]
            pairs.append((gaussian[seen], pixel[seen]))
        return pairs

    def images(self) -> list[Tensor]:
        """Image, depth and alpha of both modalities."""
        scene = self._scene
        _, means2d, depths, conics = self.project()
        images = []
        for (gaussian, pixel), opacity, features in zip(
            self.pairs,
            (scene["opacity_rgb"], scene["opacity_thermal"]),
            (scene["colors"], scene["temperatures"]),
            strict=True,
        ):
            channels = torch.cat([features, depths[0, :, None]], dim=1)[None]
            camera_index = torch.zeros_like(gaussian)
            image, alpha = self._gsplat.accumulate(
                means2d, conics, opacity[None], channels, gaussian, pixel, camera_index, *self._size
            )
            images += [image[0, ..., :-1], image[0, ..., -1], alpha[0, ..., 0]]
        return images

    def composite(self) -> tuple[Tensor, ...]:
        """Gradients of the scene, projection included; the gradient of each pixel is 1."""
        return torch.autograd.grad(
            torch.stack([image.sum() for image in self.images()]).sum(), [*self._scene.values()]
        )


def _import_reference() -> Any:
    """gsplat's reference with stand-ins for nerfacc's two helpers."""
    try:
        from gsplat.cuda import _torch_impl
    except ImportError as error:
        raise SkippedError(
            f'gsplat is not installed ({error}): pip install -e ".[bench]"'
        ) from error
    stand_in = types.ModuleType("nerfacc")
    stand_in.render_weight_from_alpha = _weights_from_alpha  # type: ignore[attr-defined]
    stand_in.accumulate_along_rays = _accumulate_along_rays  # type: ignore[attr-defined]
    sys.modules["nerfacc"] = stand_in
    return _torch_impl


def _candidates(ids: Tensor, offsets: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Every pixel of every tile with every Gaussian of the tile, sorted by pixel and then by
    distance."""
    starts = torch.cat([offsets.flatten(), torch.tensor([len(ids)])])
    tile = torch.repeat_interleave(torch.arange(offsets.numel()), starts.diff())
    inner = torch.arange(TILE_SIZE**2)
    column = (tile % offsets.shape[2] * TILE_SIZE)[:, None] + inner % TILE_SIZE
    row = (tile // offsets.shape[2] * TILE_SIZE)[:, None] + inner // TILE_SIZE
    inside = (column < width) & (row < height)
    pixel = (row * width + column)[inside]
    gaussian = ids.long()[:, None].expand(-1, len(inner))[inside]
    pixel, order = pixel.sort(stable=True)
    return gaussian[order], pixel


def transmittance_before(alpha: Tensor, ray: Tensor, rays: int) -> Tensor:
    """Π (1 − α) over the earlier samples of the same ray; the samples of a ray stand one after the
    other.

    A running sum of logarithms over all samples, in double precision, minus its value where the ray
    begins.
    """
    logs = torch.log1p(-alpha.double())
    before = torch.cat([logs.new_zeros(1), logs.cumsum(0)[:-1]]) if len(logs) > 0 else logs
    counts = torch.bincount(ray, minlength=rays)
    first = (counts.cumsum(0) - counts)[ray]
    return (before - before[first]).exp().to(alpha.dtype)


def _weights_from_alpha(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    """nerfacc's ``render_weight_from_alpha``: α T, and T."""
    transmittance = transmittance_before(alphas, ray_indices, n_rays)
    return transmittance * alphas, transmittance


def _accumulate_along_rays(
    weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int
) -> Tensor:
    """nerfacc's ``accumulate_along_rays``: Σ w v of each ray; Σ w without values."""
    source = weights[:, None] if values is None else weights[:, None] * values
    return source.new_zeros(n_rays, source.shape[1]).index_add(0, ray_indices, source)
