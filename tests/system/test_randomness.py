from __future__ import annotations

import torch

from mrgs.system.randomness import seeded


def test_what_is_drawn_follows_from_the_seed_and_leaves_nothing_behind():
    drawn = []
    for before in (1, 2):
        torch.manual_seed(before)
        state = torch.get_rng_state()
        with seeded(7):
            drawn.append(torch.rand(3))
        assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(*drawn)
    with seeded(8):
        assert not torch.equal(torch.rand(3), drawn[0])
