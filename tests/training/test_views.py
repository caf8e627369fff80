from __future__ import annotations

import pytest
import torch

from mrgs.training.state import ViewSampler


def sampler(count: int, seed: int = 0) -> tuple[ViewSampler, torch.Generator]:
    generator = torch.Generator().manual_seed(seed)
    return ViewSampler(count, generator), generator


def taken(views: ViewSampler, count: int) -> list[int]:
    """The views of so many steps of one."""
    return [number for _ in range(count) for number in views.next()]


@pytest.mark.parametrize("count", [1, 2, 7])
def test_each_round_visits_every_view_once(count):
    views, _ = sampler(count)
    for _ in range(3):
        assert sorted(taken(views, count)) == list(range(count))


def test_rounds_differ_and_the_seed_decides():
    first, second, other = sampler(20)[0], sampler(20)[0], sampler(20, seed=1)[0]
    rounds = [taken(first, 20) for _ in range(2)]
    assert rounds[0] != rounds[1]
    assert rounds[0] == taken(second, 20)
    assert rounds[0] != taken(other, 20)


@pytest.mark.parametrize("done", [0, 3, 5, 8])
def test_the_sequence_goes_on_exactly(done):
    views, generator = sampler(5)
    taken(views, done)
    waiting, random_state = views.state(), generator.get_state()
    expected = taken(views, 12)
    again, its_generator = sampler(5, seed=99)
    again.load(waiting)
    its_generator.set_state(random_state)
    assert taken(again, 12) == expected


def test_a_round_of_another_scene_is_refused():
    views, _ = sampler(3)
    with pytest.raises(ValueError, match="3 views"):
        views.load(torch.tensor([0, 3]))


def test_one_may_look_at_the_next_view_but_not_into_the_next_round():
    views, generator = sampler(3)
    before = generator.get_state()
    assert views.peek() == []  # nothing is drawn for it
    assert torch.equal(generator.get_state(), before)
    for last in (False, False, True):
        views.next()
        following = views.peek()
        assert (following == []) == last
        if not last:
            assert views.state()[0] == following[0]


@pytest.mark.parametrize(("count", "groups"), [(8, 4), (7, 3), (5, 5)])
def test_each_step_takes_a_view_of_each_group(count, groups):
    views = ViewSampler(count, torch.Generator().manual_seed(0), groups)
    steps = [views.next() for _ in range(-(-count // groups))]
    assert all([number % groups for number in step] == list(range(groups)) for step in steps)
    assert {number for step in steps for number in step} == set(range(count))
    assert views.peek() == []


@pytest.mark.parametrize("waiting", [[0], [1, 0], [0, 1, 0]])
def test_a_round_of_other_groups_is_refused(waiting):
    views = ViewSampler(4, torch.Generator(), groups=2)
    with pytest.raises(ValueError, match="2 views per step"):
        views.load(torch.tensor(waiting))


def test_the_view_that_comes_twice_in_a_round_is_another_one_each_time():
    views = ViewSampler(5, torch.Generator().manual_seed(0), groups=2)
    rounds = [[number for _ in range(3) for number in views.next()] for _ in range(20)]
    twice = {number for each in rounds for number in each if each.count(number) == 2}
    assert twice == {1, 3}


def test_views_in_groups_are_dealt_from_all():
    """The rest of a round must be found in its groups when a training resumes."""
    views = ViewSampler(6, torch.Generator(), groups=2)
    with pytest.raises(ValueError, match="groups"):
        views.restrict([1, 3, 5])
