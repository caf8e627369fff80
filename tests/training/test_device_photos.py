from __future__ import annotations

import pytest
import torch

from mrgs.training.photos import TrainingPhotos
from tests.helpers.views import posed_image

CPU = torch.device("cpu")
"""Stands for a GPU."""


def test_photos_that_fit_stay_on_the_gpu(counting_image):
    images = [counting_image(masked=True) for _ in range(3)]
    photos = TrainingPhotos(CPU, 0, gpu_limit_bytes=300)
    for image in images * 2:
        assert torch.equal(photos.load(image.posed).values, torch.full((4, 5, 1), 0.5))
    assert [image.reads for image in images] == [1, 1, 1]
    assert photos._kept_on_gpu.keys() == {image.posed for image in images}


def test_photos_that_do_not_fit_stay_in_the_hosts_memory(counting_image):
    images = [counting_image() for _ in range(3)]
    photos = TrainingPhotos(CPU, gpu_limit_bytes=100)
    for image in images * 3:
        assert torch.equal(photos.load(image.posed).values, torch.full((4, 5, 1), 0.5))
    assert photos._kept_on_gpu.keys() == {images[0].posed}
    assert [image.reads for image in images] == [1, 1, 1]


def test_memory_that_is_given_back_is_not_taken_again(counting_image):
    image = counting_image()
    photos = TrainingPhotos(CPU, gpu_limit_bytes=100)
    photos.load(image.posed)
    photos.release()
    for _ in range(3):
        photos.load(image.posed)
    assert (photos._kept_on_gpu, image.reads) == ({}, 2)


@pytest.mark.gpu
@pytest.mark.parametrize("limit_bytes", [0, None])
def test_photos_arrive_on_a_gpu(limit_bytes, counting_image):
    image = counting_image(masked=True)
    photos = TrainingPhotos(torch.device("cuda"), gpu_limit_bytes=limit_bytes)
    for _ in range(3):
        photos.fetch([image.posed])
        pixels = photos.load(image.posed)
        assert pixels.values.is_cuda
        assert pixels.valid.is_cuda
        assert torch.equal(pixels.values.cpu(), torch.full((4, 5, 1), 0.5))
    assert image.reads == 1


@pytest.mark.gpu
def test_8_bit_photos_have_the_same_bits_on_a_gpu():
    image = posed_image((torch.arange(256) / 255).repeat(3, 1)[..., None])
    photos = TrainingPhotos(torch.device("cuda"))
    for _ in range(2):
        assert torch.equal(photos.load(image).values.cpu(), image.load().values)
