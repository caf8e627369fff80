from __future__ import annotations

import pytest
import torch

from mrgs.training.device_photos import DevicePhotos

CPU = torch.device("cpu")


def test_photos_that_fit_stay_on_the_device(counting_image):
    images = [counting_image(masked=True) for _ in range(3)]
    photos = DevicePhotos(CPU, limit_bytes=300)
    kept = [photos.load(image.posed) for image in images]
    assert [image.reads for image in images] == [1, 1, 1]
    assert all(
        photos.load(image.posed) is pixels for image, pixels in zip(images, kept, strict=True)
    )


def test_photos_that_do_not_fit_are_read_once_and_copied_anew(counting_image):
    images = [counting_image() for _ in range(3)]
    photos = DevicePhotos(CPU, limit_bytes=100)
    first = [photos.load(image.posed) for image in images]
    for image in images * 3:
        assert torch.equal(photos.load(image.posed).values, torch.full((4, 5, 1), 0.5))
    assert photos.load(images[0].posed) is first[0]
    assert images[0].reads == 1
    assert [image.reads for image in images[1:]] == [
        2,
        1,
    ]  # the second showed that there is no more room


def test_what_is_fetched_is_there_when_its_turn_comes(counting_image):
    a, b = counting_image(), counting_image()
    photos = DevicePhotos(CPU, limit_bytes=0)
    photos.fetch([a.posed, b.posed])
    assert (a.reads, b.reads) == (1, 1)
    assert photos._ahead.keys() == {a.posed, b.posed}
    fetched = photos._ahead[a.posed].pixels
    assert photos.load(a.posed) is fetched
    photos.fetch([a.posed])  # b was not loaded: its copy goes
    assert photos._ahead.keys() == {a.posed}


def test_memory_that_is_given_back_is_not_taken_again(counting_image):
    image = counting_image()
    photos = DevicePhotos(CPU, limit_bytes=100)
    photos.load(image.posed)
    photos.release()
    for _ in range(3):
        photos.load(image.posed)
    assert (photos._kept, image.reads) == ({}, 2)


@pytest.mark.gpu
@pytest.mark.parametrize("limit_bytes", [0, None])
def test_photos_arrive_on_a_gpu(limit_bytes, counting_image):
    image = counting_image(masked=True)
    photos = DevicePhotos(torch.device("cuda"), limit_bytes)
    for ahead in (False, True, True):
        if ahead:
            photos.fetch([image.posed])
        pixels = photos.load(image.posed)
        assert pixels.values.is_cuda
        assert pixels.valid.is_cuda
        assert torch.equal(pixels.values.cpu(), torch.full((4, 5, 1), 0.5))
    assert image.reads == 1
