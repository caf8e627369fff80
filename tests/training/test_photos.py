from __future__ import annotations

import threading

import numpy as np
import pytest
import torch

from mrgs.errors import SceneError
from mrgs.scene import RGB, THERMAL, Camera, Pixels, PosedImage, Scene
from mrgs.training import photos
from mrgs.training.photos import TrainingPhotos, bytes_per_pixel
from tests.helpers.views import posed_image


def test_photos_are_read_once_while_there_is_room(counting_image):
    images = [counting_image() for _ in range(3)]
    kept = TrainingPhotos(limit_bytes=240)
    for image in images * 4:
        assert kept.load(image.posed).values.shape == (4, 5, 1)
    assert [image.reads for image in images] == [1, 1, 1]


def test_the_photos_that_come_first_stay(counting_image):
    a, b, c = (counting_image() for _ in range(3))
    kept = TrainingPhotos(limit_bytes=160)
    for image in (a, b, c, a, b, c):
        kept.load(image.posed)
    assert (a.reads, b.reads, c.reads) == (1, 1, 2)


def test_masks_count_too(counting_image):
    images = [counting_image(masked=True) for _ in range(2)]
    kept = TrainingPhotos(limit_bytes=199)
    for image in images * 2:
        kept.load(image.posed)
    assert [image.reads for image in images] == [1, 2]


def eight_bit(seed: int, channels: int = 3) -> torch.Tensor:
    levels = torch.randint(0, 256, (6, 7, channels), generator=torch.Generator().manual_seed(seed))
    return levels.to(torch.float32) / 255


def test_photos_of_8_bit_take_a_byte_per_channel_and_keep_their_bits():
    values, valid = eight_bit(0), torch.rand(6, 7) > 0.5
    kept = TrainingPhotos(limit_bytes=6 * 7 * 4)
    image = posed_image(values, valid)
    for _ in range(2):
        found = kept.load(image)
        assert torch.equal(found.values, values)
        assert torch.equal(found.valid, valid)
    assert kept._left_bytes == 0
    assert bytes_per_pixel(RGB) == 3


@pytest.mark.parametrize("odd", [0.5, -1 / 255, 256 / 255, float("nan")])
def test_other_photos_keep_their_bits_too(odd):
    values = eight_bit(1, channels=1)
    values[3, 2] = odd
    kept = TrainingPhotos(limit_bytes=6 * 7 * 4)
    image = posed_image(values)
    kept.load(image)
    assert torch.equal(kept.load(image).values.view(torch.int32), values.view(torch.int32))
    assert bytes_per_pixel(THERMAL) == 4


def test_kept_photos_of_all_kinds_share_blocks_of_memory():
    values = [eight_bit(seed) for seed in range(20)]
    values[3::4] = [each[..., :1] + 0.1 for each in values[3::4]]
    values.insert(7, torch.rand(50, 60, 1))  # larger than a block
    masks = [torch.rand(each.shape[:2]) > 0.5 if k % 3 else None for k, each in enumerate(values)]
    images = [posed_image(*each) for each in zip(values, masks, strict=True)]
    kept = TrainingPhotos(limit_bytes=10**6, block_bytes=1000)
    for image in images:
        kept.load(image)
    for image, expected, mask in zip(images, values, masks, strict=True):
        found = kept.load(image)
        assert torch.equal(found.values, expected)
        assert found.valid is None if mask is None else torch.equal(found.valid, mask)
    memory = {stored.values.untyped_storage().data_ptr() for stored in kept._kept.values()}
    assert len(memory) < len(images) / 2


def test_the_next_photos_are_read_by_another_thread():
    readers = []

    def load() -> Pixels:
        readers.append(threading.current_thread().name)
        return Pixels(eight_bit(2))

    image = PosedImage(posed_image(eight_bit(2)).camera, load)
    kept = TrainingPhotos(limit_bytes=0)
    kept.fetch([image])
    kept.fetch([image])  # it is on its way already
    assert torch.equal(kept.load(image).values, eight_bit(2))
    assert torch.equal(kept.load(image).values, eight_bit(2))
    assert [name.startswith("mrgs-photos") for name in readers] == [True, False]


def test_what_fails_ahead_of_its_turn_is_said_when_its_turn_comes():
    def load() -> Pixels:
        raise SceneError("a.png: cannot be decoded")

    image = PosedImage(posed_image(eight_bit(3)).camera, load)
    kept = TrainingPhotos(limit_bytes=0)
    kept.fetch([image])
    with pytest.raises(SceneError, match=r"a\.png"):
        kept.load(image)


def test_what_was_fetched_and_is_not_next_is_forgotten(counting_image):
    a, b = counting_image(), counting_image()
    kept = TrainingPhotos(limit_bytes=0)
    kept.fetch([a.posed])
    kept.fetch([b.posed])
    kept.load(b.posed)
    kept.load(a.posed)
    assert b.reads == 1
    assert not kept._ahead


def test_no_thread_is_left_behind():
    begun, may_end = threading.Event(), threading.Event()

    def load() -> Pixels:
        begun.set()
        assert may_end.wait(timeout=60)
        return Pixels(eight_bit(4))

    image, never = (PosedImage(posed_image(eight_bit(4)).camera, load) for _ in range(2))
    kept = TrainingPhotos(limit_bytes=0)
    kept.fetch([image, never])
    (reader,) = kept._reader._threads
    assert begun.wait(timeout=60)
    closer = threading.Thread(target=kept.close, daemon=True)
    closer.start()
    assert closer.is_alive(), "it waits for the photo that is being read"
    may_end.set()
    closer.join(timeout=60)
    assert not closer.is_alive()
    assert not reader.is_alive()


@pytest.mark.parametrize(("free", "limit"), [(10**9, 4 * 10**8), (None, 2 * 2**30)])
def test_the_limit_is_a_share_of_the_free_memory(free, limit, monkeypatch):
    monkeypatch.setattr(photos, "free_memory", lambda: free)
    assert photos.kept_limit() == limit


def test_photos_of_each_size_count_as_large_as_they_are():
    cameras = [Camera.from_fov(width, 10, 60) for width in (20, 10, 30)]
    scene = Scene.from_arrays(
        cameras,
        rgb=[np.zeros((10, each.width, 3), np.uint8) for each in cameras],
        points=np.random.default_rng(0).random((30, 3)),
        eval_every=0,
    )
    assert photos.kept_bytes(scene) == 3 * 10 * (20 + 10 + 30)
