"""Which view comes next, and the photos that are kept in memory."""

from __future__ import annotations

from collections import OrderedDict

import torch
from torch import Tensor

from mrgs.scene import Pixels, PosedImage

CACHE_BYTES = 2 * 2**30
"""Photos kept in memory; beyond it the least recently used are read again when their turn comes."""


class ViewSampler:
    """Every view once per round, each round in a new random order.

    Args:
        count: number of views.
        generator: of the orders; a checkpoint of it and of ``state()`` continues the sequence exactly.
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

    def state(self) -> Tensor:
        """The rest of the running round."""
        return self._waiting.clone()

    def load(self, waiting: Tensor) -> None:
        """Continue with the rest of a round.

        Raises:
            ValueError: it names a view that does not exist.
        """
        if len(waiting) > 0 and not 0 <= int(waiting.min()) <= int(waiting.max()) < self._count:
            raise ValueError(f"the round is not one of {self._count} views")
        self._waiting = waiting


class PhotoCache:
    """Photos by view, least recently used first; holds at most ``limit_bytes``."""

    def __init__(self, limit_bytes: int = CACHE_BYTES) -> None:
        self._limit_bytes = limit_bytes
        self._held_bytes = 0
        self._photos: OrderedDict[PosedImage, Pixels] = OrderedDict()

    def load(self, image: PosedImage | None) -> Pixels | None:
        """The pixels of an image, from memory if they are there."""
        if image is None:
            return None
        if image in self._photos:
            self._photos.move_to_end(image)
            return self._photos[image]
        pixels = image.load()
        self._photos[image] = pixels
        self._held_bytes += _bytes_of(pixels)
        while self._held_bytes > self._limit_bytes and len(self._photos) > 1:
            _, dropped = self._photos.popitem(last=False)
            self._held_bytes -= _bytes_of(dropped)
        return pixels


def _bytes_of(pixels: Pixels) -> int:
    return pixels.values.nbytes + (0 if pixels.valid is None else pixels.valid.nbytes)
