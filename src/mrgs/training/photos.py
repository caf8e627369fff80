"""The photos of a training: kept in memory as they are stored on disk while there is room, and read
ahead of their turn where there is not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from mrgs.data.images import eight_bit_levels, of_eight_bit_levels
from mrgs.scene import THERMAL, Modality, Pixels, PosedImage, Scene
from mrgs.system.gpu import HOST
from mrgs.system.memory import free_memory, give_back_freed

SHARE_OF_FREE_MEMORY = 0.4
"""Share of the memory free at the start that photos may take; Gaussians and steps need the rest."""

SHARE_OF_GPU_MEMORY = 0.25
"""The same share of a GPU's memory: the Gaussians, which grow, take the rest."""

LIMIT_IF_UNKNOWN = 2 * 2**30

PROBE_PX = 600
"""Least width at which a photo is read to see how its pixels are stored."""

_BLOCK_BYTES = 64 * 2**20
"""The C library gets a block of this size from the system, not from its heap."""

_ALIGNMENT = 64

P = TypeVar("P", Pixels, "_Stored")


class TrainingPhotos:
    """Photos on the device of a training.

    Those that are read first are kept while they fit, in a GPU's memory and then in the host's. The
    others are read again whenever their turn comes, by a thread beforehand if they were announced.
    Every round shows each photo once, so which of them are kept makes no difference.

    Args:
        limit_bytes: of what is kept in the host's memory; None for a share of what is free now.
        gpu_limit_bytes: of what is kept on a GPU; None for a share of what is free there now.
        block_bytes: size of the blocks that photos are kept in.
    """

    def __init__(
        self,
        device: torch.device = HOST,
        limit_bytes: int | None = None,
        gpu_limit_bytes: int | None = None,
        block_bytes: int = _BLOCK_BYTES,
    ) -> None:
        self._device = device
        self._left_bytes = kept_limit() if limit_bytes is None else limit_bytes
        if gpu_limit_bytes is None:
            torch.cuda.empty_cache()  # of earlier trainings; does nothing without a GPU
            free = torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else 0
            gpu_limit_bytes = int(SHARE_OF_GPU_MEMORY * free)
        self._gpu_left_bytes = gpu_limit_bytes
        self._kept: dict[PosedImage, _Stored] = {}
        self._kept_on_gpu: dict[PosedImage, _Stored] = {}
        self._blocks = _Blocks(block_bytes)
        self._ahead: dict[PosedImage, Future[Pixels]] = {}
        self._reader = ThreadPoolExecutor(1, thread_name_prefix="mrgs-photos")

    def load(self, image: PosedImage) -> Pixels:
        """The pixels of an image, the same bits at each call. SceneError if it cannot be read."""
        stored = self._kept_on_gpu.get(image) or self._kept.get(image)
        if stored is None:
            coming = self._ahead.pop(image, None)
            pixels = image.load() if coming is None else coming.result()
            has_room = self._left_bytes > 0 or self._gpu_left_bytes > 0
            stored = _Stored.of(pixels, exact=not has_room)
            if has_room:
                stored = self._keep(image, stored)
        return stored.to(self._device).pixels()

    def _keep(self, image: PosedImage, stored: _Stored) -> _Stored:
        """Keep an image where there is room. What comes after one that does not fit may be smaller,
        but then every photo would be tried again."""
        if stored.nbytes <= self._gpu_left_bytes:
            self._gpu_left_bytes -= stored.nbytes
            self._kept_on_gpu[image] = stored = stored.to(self._device)
            return stored
        self._gpu_left_bytes = 0
        if stored.nbytes <= self._left_bytes:
            self._left_bytes -= stored.nbytes
            self._kept[image] = change_each(stored, self._blocks.copy)
        else:
            self._left_bytes = 0
        return stored

    def fetch(self, images: Sequence[PosedImage]) -> None:
        """Begin to read these images, the next to be loaded; what was fetched and not loaded is
        forgotten. The thread leaves a GPU alone, on which a step may be recorded."""
        due = [each for each in images if each not in self._kept and each not in self._kept_on_gpu]
        for image in [image for image in self._ahead if image not in due]:
            self._ahead.pop(image).cancel()
        for image in due:
            if image not in self._ahead:
                self._ahead[image] = self._reader.submit(image.load)

    def release(self) -> None:
        """Give back the memory of a GPU, which is needed for something else from now on."""
        self._kept_on_gpu.clear()
        self._gpu_left_bytes = 0

    def close(self) -> None:
        """End the thread after the photo that it is reading; nothing more is loaded."""
        self._ahead.clear()
        self._reader.shutdown(cancel_futures=True)


class _Stored(NamedTuple):
    """The pixels of a photo as they are kept: uint8 where all are multiples of 1 / 255, as those of
    8-bit photos are, else as they are used; and the mask, if there is one."""

    values: Tensor
    valid: Tensor | None

    @classmethod
    def of(cls, pixels: Pixels, exact: bool = False) -> _Stored:
        """The stored form of pixels; ``exact`` keeps the values as they are."""
        levels = None if exact else eight_bit_levels(pixels.values)
        return cls(pixels.values if levels is None else levels, pixels.valid)

    def to(self, device: torch.device) -> _Stored:
        return change_each(self, lambda tensor: tensor.to(device))

    @property
    def nbytes(self) -> int:
        return self.values.nbytes + (0 if self.valid is None else self.valid.nbytes)

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


def kept_limit() -> int:
    """Bytes of photos that a training on the CPU would keep if it started now."""
    free = free_memory()
    return LIMIT_IF_UNKNOWN if free is None else int(SHARE_OF_FREE_MEMORY * free)


def kept_bytes(scene: Scene) -> int:
    """Bytes that the training photos of a scene take if all of them are kept, by what a pixel of
    the first of each modality takes. SceneError if that photo cannot be read."""
    total = 0.0
    for modality in scene.modalities:
        photos = scene.train_photos(modality)
        pixels = photos[0].look(PROBE_PX)
        size = _Stored.of(pixels).nbytes / pixels.values[..., 0].numel()
        total += size * sum(each.camera.width * each.camera.height for each in photos)
    return round(total)


def bytes_per_pixel(modality: Modality) -> int:
    """Bytes of a pixel of a photo that is kept."""
    return 4 if modality == THERMAL else modality.channels


def change_each(pixels: P, change: Callable[[Tensor], Tensor]) -> P:
    """Values and mask, each changed alike."""
    mask = None if pixels.valid is None else change(pixels.valid)
    return type(pixels)(change(pixels.values), mask)
