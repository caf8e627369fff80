from __future__ import annotations

import pytest
import torch

from mrgs.training.views import ViewSampler


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
