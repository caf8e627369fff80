"""What a model shows from one view: an image, a depth and an alpha of each modality."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.scene.camera import Camera
from mrgs.scene.modality import Modality, metric_first
from mrgs.scene.preview import preview_png

SOLID_ALPHA = 0.5
"""A pixel that is covered less shows no surface."""


class Blend(NamedTuple):
    """One modality alpha-blended from one camera.

    Attributes:
        image: colours, normalised temperatures or another modality's values, not clamped,
            [H, W, C].
        depth: z-depth blended with the same weights, scene units, not divided by alpha, [H, W]; NaN
            everywhere if it is not known.
        alpha: accumulated alpha, [H, W]; NaN everywhere if it is not known.
    """

    image: Float[Tensor, "h w c"]
    depth: Float[Tensor, "h w"]
    alpha: Float[Tensor, "h w"]

    def __repr__(self) -> str:
        height, width, channels = self.image.shape
        return f"Blend({width}×{height}, {channels} channels)"

    @classmethod
    def of_image(cls, image: Float[Tensor, "h w c"]) -> Blend:
        """An image alone, without a known depth and alpha."""
        unknown = torch.full(image.shape[:2], torch.nan, device=image.device)
        return cls(image, unknown, unknown)


DepthFinder: TypeAlias = Callable[[], Float[Tensor, "h w"]]
"""Finds a median depth when it is needed."""


class Rendering(Mapping[Modality, Blend]):
    """What a model shows from one view: a ``Blend`` for each modality that has a camera.

    Args:
        median_depths: z-depths at which half of the light is blocked, scene units, [H, W] each; NaN
            where less than half is. Or functions that find them, which are called once, when the
            depth is first read. Empty where they were not asked for, as in training.
    """

    def __init__(
        self,
        blends: Mapping[Modality, Blend],
        median_depths: Mapping[Modality, Float[Tensor, "h w"] | DepthFinder] | None = None,
    ) -> None:
        self._blends = dict(blends)
        self._median_depths = {
            each: cache(depth) if callable(depth) else depth
            for each, depth in (median_depths or {}).items()
        }

    def __getitem__(self, modality: Modality) -> Blend:
        return self._blends[modality]

    def __iter__(self) -> Iterator[Modality]:
        return iter(self._blends)

    def __len__(self) -> int:
        return len(self._blends)

    def __reduce__(self) -> tuple[Any, ...]:
        """For pickle: the depths are found first, because a process cannot send functions."""
        depths = {each: self._median_depth(each) for each in self._median_depths}
        return Rendering, (self._blends, depths)

    def __repr__(self) -> str:
        return f"Rendering({', '.join(f'{each}: {blend!r}' for each, blend in self.items())})"

    def _repr_png_(self) -> bytes:
        """The images side by side, for a notebook."""
        return preview_png([blend.image for blend in self.values()])

    def has_depth(self, modality: Modality) -> bool:
        """Whether the depth of a modality is known."""
        return modality in self._median_depths or not bool(self[modality].depth.isnan().all())

    def with_depth(self, first: Modality) -> Modality | None:
        """The modality whose depth is shown or scored: ``first`` if its depth is known, or else
        another one; None if there is no depth."""
        known = [modality for modality in self if self.has_depth(modality)]
        return first if first in known else next(iter(known), None)

    def surface_depth(
        self, modality: Modality, min_alpha: float = SOLID_ALPHA, max_step: float | None = None
    ) -> Float[Tensor, "h w"]:
        """z-depth of the surface that a pixel of a modality shows: the median depth, or where that
        was not asked for D / A, the blended depth without the share of the background. In scene
        units, NaN where there is no surface, [H, W].

        Args:
            min_alpha: a pixel that is covered less shows no surface.
            max_step: largest difference of depth within 3×3 pixels, as a share of the pixel's; one
                of more lies on an outline, where the mean depth is that of neither surface. None to
                keep outlines.
        """
        _, depth, alpha = self[modality]
        median = self._median_depth(modality)
        surface = depth / alpha.clamp_min(min_alpha) if median is None else median
        surface = torch.where(alpha < min_alpha, torch.nan, surface)
        if max_step is None:
            return surface
        return torch.where(_depth_range(surface) > max_step * surface, torch.nan, surface)

    def visible_depth(self) -> Float[Tensor, "h w"]:
        """z-depth of the visible surface, scene units, [H, W], NaN where no modality shows one: of
        the first that covers the pixel, those with a unit first, whose coldest things may be
        transparent."""
        first, *others = metric_first(self)
        depth = self.surface_depth(first)
        for each in others:
            if depth.isnan().any():
                depth = torch.where(depth.isnan(), self.surface_depth(each), depth)
        return depth

    def _median_depth(self, modality: Modality) -> Float[Tensor, "h w"] | None:
        """A median depth, found now if it was not yet; None if it was not asked for."""
        depth = self._median_depths.get(modality)
        return depth() if callable(depth) else depth

    def cpu(self) -> Rendering:
        """The same images in the host's memory."""

        def on_host(modality: Modality) -> Float[Tensor, "h w"]:
            depth = self._median_depth(modality)
            assert depth is not None
            return depth.cpu()

        return Rendering(
            {each: Blend(*(tensor.cpu() for tensor in blend)) for each, blend in self.items()},
            {each: partial(on_host, each) for each in self._median_depths},
        )

    def with_images(self, images: Mapping[Modality, Float[Tensor, "h w c"]]) -> Rendering:
        """The same rendering with other images of some modalities; depths and alphas are kept."""
        return Rendering(
            {
                modality: blend._replace(image=images.get(modality, blend.image))
                for modality, blend in self.items()
            },
            self._median_depths,
        )

    def with_depths(
        self, change: Callable[[Float[Tensor, "h w"]], Float[Tensor, "h w"]]
    ) -> Rendering:
        """The same images with each depth of a surface changed, when it is first read."""

        def changed(modality: Modality) -> Float[Tensor, "h w"]:
            return change(self.surface_depth(modality))

        return Rendering(self, {each: partial(changed, each) for each in self})


NOT_COARSER: Mapping[Modality, float] = MappingProxyType({})
"""Pixel sizes of a rendering with the photos' own pixels."""


@runtime_checkable
class CameraResponse(Protocol):
    """What the scene's cameras make of a rendering."""

    def __call__(
        self,
        rendering: Rendering,
        camera: Camera,
        pixel_sizes: Mapping[Modality, float] = NOT_COARSER,
    ) -> Rendering:
        """What they would have recorded. ``pixel_sizes`` are those of its images, in pixels of the
        photos; 1 where none is given."""


def ideal_cameras(
    rendering: Rendering, camera: Camera, pixel_sizes: Mapping[Modality, float] = NOT_COARSER
) -> Rendering:
    """A camera response that changes nothing."""
    return rendering


def _depth_range(depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Largest minus smallest depth within 3×3 pixels; NaN does not count."""
    far, minus_near = (
        torch.nn.functional.max_pool2d(
            signed.nan_to_num(nan=-torch.inf)[None], 3, stride=1, padding=1
        )[0]
        for signed in (depth, -depth)
    )
    return far + minus_near
