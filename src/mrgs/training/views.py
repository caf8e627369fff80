"""Which view comes next, and the photos that are kept in memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Protocol

import torch
from torch import Tensor

from mrgs.scene import Pixels, PosedImage

CACHE_BYTES = 2 * 2**30
"""Photos kept in memory; beyond it the least recently used are read again when their turn comes."""


class ViewSampler:
    """Every view once per round, each round in a new random order.

    Args:
        count: number of views.
        generator: of the orders; a checkpoint of it and of ``state()`` continues the sequence
            exactly.
    """

    def __init__(self, count: int, generator: torch.Generator) -> None:
        self._count = count
        self._generator = generator
        self._waiting = torch.empty(0, dtype=torch.int64)

    def next(self) -> int:
        """Index of the next view."""
        if len(self._waiting) == 0:
            self._waiting = torch.randperm(self._count, generator=self._generator)
        index, self._waiting = int(self._waiting[0]), self._waiting[1:]
        return index

    def peek(self) -> int | None:
        """Index of the view after that; None at the end of a round, since the next one is not drawn
        yet."""
        return int(self._waiting[0]) if len(self._waiting) > 0 else None

    def state(self) -> Tensor:
        """The rest of the running round."""
        return self._waiting.clone()

    def load(self, waiting: Tensor) -> None:
        """Continue with the rest of a round.

        Raises:
            ValueError: it names a view that does not exist, or one twice.
        """
        is_list = waiting.dtype == torch.int64 and waiting.dim() == 1
        if not is_list or not set(waiting.tolist()) <= set(range(self._count)):
            raise ValueError(f"the round is not one of {self._count} views")
        if len(waiting.unique()) < len(waiting):
            raise ValueError("the round names a view twice")
        self._waiting = waiting


class PhotoCache:
    """Photos by view, least recently used first.

    Args:
        limit_bytes: of what is held.
        pinned: whether they are held in page-locked memory, from which a GPU copies without the
            processor.
    """

    def __init__(self, limit_bytes: int = CACHE_BYTES, pinned: bool = False) -> None:
        self._limit_bytes = limit_bytes
        self._pinned = pinned
        self._held_bytes = 0
        self._photos: OrderedDict[PosedImage, Pixels] = OrderedDict()

    def load(self, image: PosedImage) -> Pixels:
        """The pixels of an image, from memory if they are there."""
        if image in self._photos:
            self._photos.move_to_end(image)
            return self._photos[image]
        pixels = image.load()
        if self._pinned:
            pixels = change_each(pixels, Tensor.pin_memory)
        self._photos[image] = pixels
        self._held_bytes += bytes_of(pixels)
        while self._held_bytes > self._limit_bytes and len(self._photos) > 1:
            _, dropped = self._photos.popitem(last=False)
            self._held_bytes -= bytes_of(dropped)
        return pixels

    def fetch(self, images: Sequence[PosedImage]) -> None:
        """Nothing: on a CPU, to read ahead is to read now."""

    def release(self) -> None:
        """Nothing: no memory of a GPU is held."""


class PhotoSource(Protocol):
    """Where a training gets its photos from."""

    def load(self, image: PosedImage) -> Pixels:
        """The pixels of an image, on the training's device."""

    def fetch(self, images: Sequence[PosedImage]) -> None:
        """Start loading the images that come next."""

    def release(self) -> None:
        """Give back the memory of a GPU, which is needed for something else."""


def change_each(pixels: Pixels, change: Callable[[Tensor], Tensor]) -> Pixels:
    """Values and mask, each changed alike."""
    return Pixels(change(pixels.values), None if pixels.valid is None else change(pixels.valid))


def bytes_of(pixels: Pixels) -> int:
    """Size of an image's values and mask, in bytes."""
    return pixels.values.nbytes + (0 if pixels.valid is None else pixels.valid.nbytes)
