from __future__ import annotations

import pytest
import torch

from mrgs.scene import Camera, Pixels, PosedImage
from mrgs.training.views import DevicePhotos, PhotoCache, ViewSampler


def sampler(count: int, seed: int = 0) -> tuple[ViewSampler, torch.Generator]:
    generator = torch.Generator().manual_seed(seed)
    return ViewSampler(count, generator), generator


@pytest.mark.parametrize("count", [1, 2, 7])
def test_each_round_visits_every_view_once(count):
    views, _ = sampler(count)
    for _ in range(3):
        assert sorted(views.next() for _ in range(count)) == list(range(count))


def test_rounds_differ_and_the_seed_decides():
    first, second, other = sampler(20)[0], sampler(20)[0], sampler(20, seed=1)[0]
    rounds = [[first.next() for _ in range(20)] for _ in range(2)]
    assert rounds[0] != rounds[1]
    assert rounds[0] == [second.next() for _ in range(20)]
    assert rounds[0] != [other.next() for _ in range(20)]


@pytest.mark.parametrize("done", [0, 3, 5, 8])
def test_the_sequence_goes_on_exactly(done):
    views, generator = sampler(5)
    for _ in range(done):
        views.next()
    waiting, random_state = views.state(), generator.get_state()
    expected = [views.next() for _ in range(12)]
    again, its_generator = sampler(5, seed=99)
    again.load(waiting)
    its_generator.set_state(random_state)
    assert [again.next() for _ in range(12)] == expected


def test_a_round_of_another_scene_is_refused():
    views, _ = sampler(3)
    with pytest.raises(ValueError, match="the round is not one of 3 views"):
        views.load(torch.tensor([0, 3]))


class CountingImage:
    """A float image of 4×5×1 (80 bytes), with a mask of 20 bytes if asked for, which counts how often it is read."""

    def __init__(self, masked: bool = False) -> None:
        self.reads = 0
        valid = torch.ones(4, 5, dtype=torch.bool) if masked else None
        camera = Camera(torch.eye(3, dtype=torch.float64), torch.eye(4, dtype=torch.float64), 5, 4)
        self.posed = PosedImage(camera, lambda: self.read(valid))

    def read(self, valid: torch.Tensor | None) -> Pixels:
        self.reads += 1
        return Pixels(torch.full((4, 5, 1), 0.5), valid)


def test_photos_are_read_once_while_there_is_room():
    images = [CountingImage() for _ in range(3)]
    cache = PhotoCache(limit_bytes=240)
    for image in images * 4:
        assert cache.load(image.posed).values.shape == (4, 5, 1)
    assert [image.reads for image in images] == [1, 1, 1]


def test_the_least_recently_used_photo_goes_first():
    a, b, c = (CountingImage() for _ in range(3))
    cache = PhotoCache(limit_bytes=160)
    for image in (a, b, a, c):  # c takes the place of b
        cache.load(image.posed)
    cache.load(a.posed)
    assert (a.reads, b.reads, c.reads) == (1, 1, 1)
    cache.load(b.posed)
    assert b.reads == 2


def test_masks_count_too():
    images = [CountingImage(masked=True) for _ in range(2)]
    cache = PhotoCache(limit_bytes=199)
    for image in images * 2:
        cache.load(image.posed)
    assert [image.reads for image in images] == [2, 2]


def test_a_photo_larger_than_the_cache_is_still_given():
    image = CountingImage()
    cache = PhotoCache(limit_bytes=10)
    assert cache.load(image.posed) is cache.load(image.posed)


def test_one_may_look_at_the_next_view_but_not_into_the_next_round():
    views, generator = sampler(3)
    before = generator.get_state()
    assert views.peek() is None  # nothing is drawn for it
    assert torch.equal(generator.get_state(), before)
    for last in (False, False, True):
        views.next()
        following = views.peek()
        assert (following is None) == last
        if not last:
            assert views.state()[0] == following


CPU = torch.device("cpu")


def test_photos_that_fit_stay_on_the_device():
    images = [CountingImage(masked=True) for _ in range(3)]
    photos = DevicePhotos(CPU, limit_bytes=300)
    kept = [photos.load(image.posed) for image in images]
    assert [image.reads for image in images] == [1, 1, 1]
    assert all(photos.load(image.posed) is pixels for image, pixels in zip(images, kept, strict=True))


def test_photos_that_do_not_fit_are_read_once_and_copied_anew():
    images = [CountingImage() for _ in range(3)]
    photos = DevicePhotos(CPU, limit_bytes=100)
    first = [photos.load(image.posed) for image in images]
    for image in images * 3:
        assert torch.equal(photos.load(image.posed).values, torch.full((4, 5, 1), 0.5))
    assert photos.load(images[0].posed) is first[0]
    assert images[0].reads == 1
    assert [image.reads for image in images[1:]] == [2, 1]  # the second showed that there is no more room


def test_what_is_fetched_is_there_when_its_turn_comes():
    a, b = CountingImage(), CountingImage()
    photos = DevicePhotos(CPU, limit_bytes=0)
    photos.fetch([a.posed, b.posed])
    assert (a.reads, b.reads) == (1, 1)
    assert photos._ahead.keys() == {a.posed, b.posed}
    fetched = photos._ahead[a.posed].pixels
    assert photos.load(a.posed) is fetched
    photos.fetch([a.posed])  # b was not loaded: its copy goes
    assert photos._ahead.keys() == {a.posed}


def test_memory_that_is_given_back_is_not_taken_again():
    image = CountingImage()
    photos = DevicePhotos(CPU, limit_bytes=100)
    photos.load(image.posed)
    photos.release()
    for _ in range(3):
        photos.load(image.posed)
    assert (photos._kept, image.reads) == ({}, 2)


@pytest.mark.gpu
@pytest.mark.parametrize("limit_bytes", [0, None])
def test_photos_arrive_on_a_gpu(limit_bytes):
    image = CountingImage(masked=True)
    photos = DevicePhotos(torch.device("cuda"), limit_bytes)
    for ahead in (False, True, True):
        if ahead:
            photos.fetch([image.posed])
        pixels = photos.load(image.posed)
        assert pixels.values.is_cuda
        assert pixels.valid.is_cuda
        assert torch.equal(pixels.values.cpu(), torch.full((4, 5, 1), 0.5))
    assert image.reads == 1
