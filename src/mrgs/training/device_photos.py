"""Photos for a training on a GPU."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch

from mrgs.scene import Pixels, PosedImage
from mrgs.training.photos import HostPhotos, bytes_of, change_each

SHARE_OF_FREE_MEMORY = 0.25
"""Of a GPU's free memory at the start, for photos: most of the rest is for the Gaussians, which
grow in number."""


class DevicePhotos:
    """Photos on a GPU: kept there while they fit, the others copied from the host. On request they
    are copied ahead of their turn, or read by a thread where they have yet to be.

    The thread leaves the GPU alone, which takes nothing from others while a step is recorded.

    Args:
        device: a CUDA device.
        limit_bytes: of what is kept there; None for a share of the memory that is free now.
        host_limit_bytes: of what is kept in the host's memory, as in ``HostPhotos``.
    """

    def __init__(
        self,
        device: torch.device,
        limit_bytes: int | None = None,
        host_limit_bytes: int | None = None,
    ) -> None:
        self._device = device
        free = _free_bytes(device) if limit_bytes is None else 0
        self._left_bytes = int(SHARE_OF_FREE_MEMORY * free) if limit_bytes is None else limit_bytes
        self._kept: dict[PosedImage, Pixels] = {}
        self._host = HostPhotos(host_limit_bytes, pinned=device.type == "cuda")
        self._copier = _Copier(device)
        self._ahead: dict[PosedImage, Copied] = {}
        self._copies_ahead = True

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
        pixels = change_each(self._host.read(image), lambda tensor: tensor.to(self._device))
        if bytes_of(pixels) <= self._left_bytes:
            self._kept[image] = pixels
            self._left_bytes -= bytes_of(pixels)
        else:  # what comes later may be smaller, but then every photo would be tried again
            self._left_bytes = 0
        return pixels

    def fetch(self, images: Sequence[PosedImage]) -> None:
        """Begin to copy or to read these images, the next to be loaded; what was fetched and not
        loaded is forgotten."""
        due = [image for image in images if image not in self._kept]
        self._ahead = {image: copied for image, copied in self._ahead.items() if image in due}
        coming = [image for image in due if image not in self._ahead]
        if self._copies_ahead:
            for image in filter(self._host.keeps, coming):
                self._ahead[image] = self._copier.send(self._host.load(image))
        self._host.fetch(coming)

    def release(self) -> None:
        """Give back the memory of the GPU; from now on every photo is copied when its turn
        comes."""
        self._kept.clear()
        self._ahead.clear()
        self._left_bytes = 0
        self._copies_ahead = False

    def close(self) -> None:
        """Forget the copies on their way, and end the thread."""
        self._ahead.clear()
        self._host.close()


class Copied(NamedTuple):
    """An image on its way to the GPU, and the event of its arrival."""

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
            there = change_each(pixels, lambda tensor: tensor.to(self._device, non_blocking=True))
            return Copied(there, self._stream.record_event())

    def receive(self, copied: Copied) -> Pixels:
        """The copy; what is queued from now on waits for it, the host does not."""
        if copied.arrived is None:
            return copied.pixels
        current = torch.cuda.current_stream(self._device)
        current.wait_event(copied.arrived)
        for tensor in (copied.pixels.values, copied.pixels.valid):
            if tensor is not None:
                tensor.record_stream(
                    current
                )  # its memory is free again when this stream has read it
        return copied.pixels


def _free_bytes(device: torch.device) -> int:
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else 0
