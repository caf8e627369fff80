from __future__ import annotations

import threading

import pytest
import torch

from mrgs.errors import SceneError
from mrgs.scene import Pixels, PosedImage
from mrgs.training.photos import DevicePhotos
from tests.helpers.views import posed_image

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
    for image in (a, b):
        photos.load(image.posed)  # from now on in the host's memory
    photos.fetch([a.posed, b.posed])
    assert (a.reads, b.reads) == (1, 1)
    assert photos._ahead.keys() == {a.posed, b.posed}
    fetched = photos._ahead[a.posed].pixels
    assert photos.load(a.posed) is fetched
    photos.fetch([a.posed])  # b was not loaded: its copy goes
    assert photos._ahead.keys() == {a.posed}
    photos.close()
    assert not photos._ahead


@pytest.mark.parametrize(
    ("limit_bytes", "host_limit_bytes"),
    [(10**6, 0), (0, 10**6), (0, 0)],
    ids=["device", "host", "nowhere"],
)
def test_photos_are_read_by_another_thread_while_this_one_goes_on(limit_bytes, host_limit_bytes):
    readers, goes_on = [], threading.Event()
    expected = torch.rand(4, 5, 1)

    def load() -> Pixels:
        assert goes_on.wait(timeout=60)
        readers.append(threading.current_thread().name)
        return Pixels(expected)

    image = PosedImage(posed_image(expected).camera, load)
    photos = DevicePhotos(CPU, limit_bytes, host_limit_bytes)
    photos.fetch([image])
    goes_on.set()
    assert torch.equal(photos.load(image).values, expected)
    assert [name.startswith("mrgs-photos") for name in readers] == [True]
    photos.close()


def test_what_fails_ahead_of_its_turn_is_said_when_its_turn_comes():
    def load() -> Pixels:
        raise SceneError("a.png: cannot be decoded")

    image = PosedImage(posed_image(torch.rand(4, 5, 1)).camera, load)
    photos = DevicePhotos(CPU, limit_bytes=10**6)
    photos.fetch([image])
    with pytest.raises(SceneError, match=r"a\.png"):
        photos.load(image)


def test_where_memory_was_given_back_nothing_is_copied_ahead(counting_image):
    image = counting_image()
    photos = DevicePhotos(CPU, limit_bytes=0)
    photos.load(image.posed)
    photos.release()
    photos.fetch([image.posed])
    assert not photos._ahead
    photos.load(image.posed)
    assert image.reads == 1


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
