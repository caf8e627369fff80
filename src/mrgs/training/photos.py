"""The photos of a training: kept in memory as they are stored on disk while there is room, and read
ahead of their turn where there is not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from mrgs.data.images import eight_bit_levels, of_eight_bit_levels
from mrgs.scene import THERMAL, Modality, Pixels, PosedImage, Scene
from mrgs.system.gpu import lacks_memory
from mrgs.system.memory import free_memory, give_back_freed

SHARE_OF_FREE_MEMORY = 0.4
"""Of what is free when the training starts; the Gaussians and a step need the rest."""

SHARE_OF_GPU_MEMORY = 0.25
"""Of a GPU's free memory at the start, for photos: most of the rest is for the Gaussians, which
grow in number."""

LIMIT_IF_UNKNOWN = 2 * 2**30

LOOKED_AT_PX = 600
"""A photo that is so wide tells how its pixels are stored."""

_BLOCK_BYTES = 64 * 2**20
"""The C library gets a block of this size from the system, not from its heap."""

_ALIGNMENT = 64


class PhotoSource(Protocol):
    """Where a training gets its photos from."""

    def load(self, image: PosedImage) -> Pixels:
        """The pixels of an image, on the training's device."""

    def fetch(self, images: Sequence[PosedImage]) -> None:
        """Start loading the images that come next."""

    def release(self) -> None:
        """Give back the memory of a GPU, which is needed for something else."""

    def close(self) -> None:
        """Stop loading; nothing is asked for any more."""


class HostPhotos:
    """Photos in the host's memory: those that are read first are kept while they fit, the others
    are read again whenever their turn comes, on request by a thread beforehand.

    Every round shows each photo once, so which of them are kept makes no difference.

    Args:
        limit_bytes: of what is kept; None for a share of the memory that is free now.
        pinned: whether they are kept in page-locked memory, from which a GPU copies without the
            processor; they are then kept as they are used.
        pin: copies a tensor into such memory.
        block_bytes: that others are put into together.
    """

    def __init__(
        self,
        limit_bytes: int | None = None,
        pinned: bool = False,
        pin: Callable[[Tensor], Tensor] = Tensor.pin_memory,
        block_bytes: int = _BLOCK_BYTES,
    ) -> None:
        self._left_bytes = kept_limit() if limit_bytes is None else limit_bytes
        self._pinned, self._pin = pinned, pin
        self._kept: dict[PosedImage, _Stored] = {}
        self._blocks = _Blocks(block_bytes)
        self._ahead: dict[PosedImage, Future[Pixels]] = {}
        self._reader = ThreadPoolExecutor(1, thread_name_prefix="mrgs-photos")

    def load(self, image: PosedImage) -> Pixels:
        """The pixels of an image, the same bits at each call.

        Raises:
            SceneError: it cannot be read.
        """
        if image in self._kept:
            return self._kept[image].pixels()
        pixels = self.read(image)
        if self._pinned:
            pixels = self._page_locked(pixels)
        if self._left_bytes > 0:
            self._keep(image, pixels)
        return pixels

    def _page_locked(self, pixels: Pixels) -> Pixels:
        """Copies in page-locked memory; once that fails, photos stay in ordinary memory."""
        try:
            return change_each(pixels, self._pin)
        except RuntimeError as error:
            if not lacks_memory(error):
                raise
        self._pinned = False
        return pixels

    def keeps(self, image: PosedImage) -> bool:
        """Whether an image is in memory, and need not be read."""
        return image in self._kept

    def read(self, image: PosedImage) -> Pixels:
        """The pixels of an image that is not kept: as the thread has read them beforehand, or from
        the file now. They are not kept by this.

        Raises:
            SceneError: it cannot be read.
        """
        coming = self._ahead.pop(image, None)
        return image.load() if coming is None else coming.result()

    def _keep(self, image: PosedImage, pixels: Pixels) -> None:
        stored = _Stored.of(pixels, exact=self._pinned)
        taken = stored.pinned_bytes if self._pinned else stored.nbytes
        if taken <= self._left_bytes:
            # Page-locked memory does not come from the heap.
            self._kept[image] = stored if self._pinned else stored.copied_to(self._blocks)
            self._left_bytes -= taken
        else:  # what comes later may be smaller, but then every photo would be tried again
            self._left_bytes = 0

    def fetch(self, images: Sequence[PosedImage]) -> None:
        """Begin to read these images, the next to be loaded; what was fetched and not loaded is
        forgotten."""
        due = [image for image in images if image not in self._kept]
        for image in [image for image in self._ahead if image not in due]:
            self._ahead.pop(image).cancel()
        for image in due:
            if image not in self._ahead:
                self._ahead[image] = self._reader.submit(image.load)

    def release(self) -> None:
        """Nothing: no memory of a GPU is held."""

    def close(self) -> None:
        """End the thread, which finishes the photo that it is reading."""
        self._ahead.clear()
        self._reader.shutdown(cancel_futures=True)


class _Stored(NamedTuple):
    """The pixels of a photo as they are kept.

    Attributes:
        values: uint8 where all are multiples of 1 / 255, as those of 8-bit photos are; else as they
            are used.
        valid: the mask, if there is one.
    """

    values: Tensor
    valid: Tensor | None

    @classmethod
    def of(cls, pixels: Pixels, exact: bool) -> _Stored:
        """From the pixels; ``exact`` keeps the values as they are."""
        if not exact:
            levels = eight_bit_levels(pixels.values)
            if levels is not None:
                return cls(levels, pixels.valid)
        return cls(pixels.values, pixels.valid)

    def copied_to(self, blocks: _Blocks) -> _Stored:
        """The same photo in memory of the blocks."""
        valid = None if self.valid is None else blocks.copy(self.valid)
        return _Stored(blocks.copy(self.values), valid)

    @property
    def nbytes(self) -> int:
        return self.values.nbytes + (0 if self.valid is None else self.valid.nbytes)

    @property
    def pinned_bytes(self) -> int:
        """What they take in page-locked memory, of which torch takes powers of two."""
        tensors = (self.values,) if self.valid is None else (self.values, self.valid)
        return sum(1 << (tensor.nbytes - 1).bit_length() for tensor in tensors)

    def pixels(self) -> Pixels:
        if self.values.dtype == torch.uint8:
            return Pixels(of_eight_bit_levels(self.values), self.valid)
        return Pixels(self.values, self.valid)


class _Blocks:
    """Large blocks of memory for arrays that stay: one by one in the C library's heap, among the
    arrays of a step, they would leave gaps that the next step's do not fit into."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._block = torch.empty(0, dtype=torch.uint8)
        self._used = 0

    def copy(self, tensor: Tensor) -> Tensor:
        """A copy of a tensor in the current block, or in a new one if it does not fit."""
        if self._used + tensor.nbytes > self._block.nbytes:
            give_back_freed()
            self._block = torch.empty(max(self._size, tensor.nbytes), dtype=torch.uint8)
            self._used = 0
        place = self._block[self._used : self._used + tensor.nbytes]
        self._used += -(-tensor.nbytes // _ALIGNMENT) * _ALIGNMENT
        return place.view(tensor.dtype).view(tensor.shape).copy_(tensor)


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
        self._left_bytes = int(SHARE_OF_GPU_MEMORY * free) if limit_bytes is None else limit_bytes
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


def kept_limit() -> int:
    """Bytes of photos that a training on the CPU would keep if it started now."""
    free = free_memory()
    return LIMIT_IF_UNKNOWN if free is None else int(SHARE_OF_FREE_MEMORY * free)


def kept_bytes(scene: Scene) -> int:
    """Bytes that the training photos of a scene take if all of them are kept, by what a pixel of
    the first of each modality takes.

    Raises:
        SceneError: that photo cannot be read.
    """
    total = 0.0
    for modality in scene.modalities:
        photos = scene.train_photos(modality)
        pixels = photos[0].look(LOOKED_AT_PX)
        size = _Stored.of(pixels, exact=False).nbytes / pixels.values[..., 0].numel()
        total += size * sum(each.camera.width * each.camera.height for each in photos)
    return round(total)


def bytes_per_pixel(modality: Modality) -> int:
    """Of a photo that is kept."""
    return 4 if modality == THERMAL else modality.channels


def change_each(pixels: Pixels, change: Callable[[Tensor], Tensor]) -> Pixels:
    """Values and mask, each changed alike."""
    return Pixels(change(pixels.values), None if pixels.valid is None else change(pixels.valid))


def bytes_of(pixels: Pixels) -> int:
    """Size of an image's values and mask, in bytes."""
    return pixels.values.nbytes + (0 if pixels.valid is None else pixels.valid.nbytes)
