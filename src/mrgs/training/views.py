"""Which view comes next, and the photos that are kept in memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from mrgs.scene import Pixels, PosedImage

CACHE_BYTES = 2 * 2**30
"""Photos kept in memory; beyond it the least recently used are read again when their turn comes."""


SHARE_OF_FREE_MEMORY = 0.25
"""Of a GPU's free memory at the start, for photos: most of the rest is for the Gaussians, which grow in number."""


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

    def peek(self) -> int | None:
        """Index of the view after that; None at the end of a round, since the next one is not drawn yet."""
        return int(self._waiting[0]) if len(self._waiting) > 0 else None

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
    """Photos by view, least recently used first.

    Args:
        limit_bytes: of what is held.
        pinned: whether they are held in page-locked memory, from which a GPU copies without the processor.
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
            pixels = _each(pixels, Tensor.pin_memory)
        self._photos[image] = pixels
        self._held_bytes += _bytes_of(pixels)
        while self._held_bytes > self._limit_bytes and len(self._photos) > 1:
            _, dropped = self._photos.popitem(last=False)
            self._held_bytes -= _bytes_of(dropped)
        return pixels

    def fetch(self, images: Sequence[PosedImage]) -> None:
        """Nothing: on a CPU, to read ahead is to read now."""

    def release(self) -> None:
        """Nothing: no memory of a GPU is held."""


class Photographs(Protocol):
    """Where a training gets its photos from."""

    def load(self, image: PosedImage) -> Pixels:
        """The pixels of an image, on the training's device."""

    def fetch(self, images: Sequence[PosedImage]) -> None:
        """Told which images will be loaded next."""

    def release(self) -> None:
        """Give back the memory of a GPU, which is needed for something else."""


class DevicePhotos:
    """Photos on a GPU: kept there while they fit, the others copied from the host, ahead of their turn if told to.

    Args:
        device: a CUDA device.
        limit_bytes: of what is kept there; None for a share of the memory that is free now.
    """

    def __init__(self, device: torch.device, limit_bytes: int | None = None) -> None:
        self._device = device
        free = _free_bytes(device) if limit_bytes is None else 0
        self._left_bytes = int(SHARE_OF_FREE_MEMORY * free) if limit_bytes is None else limit_bytes
        self._kept: dict[PosedImage, Pixels] = {}
        self._host = PhotoCache(pinned=device.type == "cuda")
        self._copier = _Copier(device)
        self._ahead: dict[PosedImage, Copied] = {}

    def load(self, image: PosedImage) -> Pixels:
        """The pixels of an image, on the device."""
        if image in self._kept:
            return self._kept[image]
        if image in self._ahead:
            return self._copier.receive(self._ahead.pop(image))
        if self._left_bytes > 0:
            return self._load_to_keep(image)
        return self._copier.receive(self._copier.send(self._host.load(image)))

    def _load_to_keep(self, image: PosedImage) -> Pixels:
        pixels = _each(image.load(), lambda tensor: tensor.to(self._device))
        if _bytes_of(pixels) <= self._left_bytes:
            self._kept[image] = pixels
            self._left_bytes -= _bytes_of(pixels)
        else:  # what comes later may be smaller, but then every photo would be tried again
            self._left_bytes = 0
        return pixels

    def fetch(self, images: Sequence[PosedImage]) -> None:
        """Begin to copy these images, the next to be loaded; what was fetched and not loaded is forgotten."""
        due = [image for image in images if image not in self._kept]
        self._ahead = {image: copied for image, copied in self._ahead.items() if image in due}
        if self._left_bytes > 0:  # it will be kept: no need to hurry
            return
        for image in due:
            if image not in self._ahead:
                self._ahead[image] = self._copier.send(self._host.load(image))

    def release(self) -> None:
        """Give back the memory of the GPU; from now on every photo is copied when its turn comes."""
        self._kept.clear()
        self._ahead.clear()
        self._left_bytes = 0


class Copied(NamedTuple):
    """An image on its way to the GPU, and what tells that it has arrived."""

    pixels: Pixels
    arrived: torch.cuda.Event | None


class _Copier:
    """Copies from the host beside the training's own queue of work."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None

    def send(self, pixels: Pixels) -> Copied:
        """Begin to copy."""
        if self._stream is None:
            return Copied(pixels, None)
        with torch.cuda.stream(self._stream):
            there = _each(pixels, lambda tensor: tensor.to(self._device, non_blocking=True))
            return Copied(there, self._stream.record_event())

    def receive(self, copied: Copied) -> Pixels:
        """The copy; what is queued from now on waits for it, the host does not."""
        if copied.arrived is None:
            return copied.pixels
        current = torch.cuda.current_stream(self._device)
        current.wait_event(copied.arrived)
        for tensor in (copied.pixels.values, copied.pixels.valid):
            if tensor is not None:
                tensor.record_stream(current)  # its memory is free again when this stream has read it
        return copied.pixels


def _free_bytes(device: torch.device) -> int:
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else 0


def _each(pixels: Pixels, change: Callable[[Tensor], Tensor]) -> Pixels:
    return Pixels(change(pixels.values), None if pixels.valid is None else change(pixels.valid))


def _bytes_of(pixels: Pixels) -> int:
    return pixels.values.nbytes + (0 if pixels.valid is None else pixels.valid.nbytes)
