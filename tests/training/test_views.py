from __future__ import annotations

import pytest
import torch

from mrgs.scene import Camera, Pixels, PosedImage
from mrgs.training.views import PhotoCache, ViewSampler


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
    assert cache.load(None) is None


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
