from __future__ import annotations

from dataclasses import replace

import torch

from mrgs.export.page.visibility import blending_weights, most_visible
from mrgs.scene import RGB, THERMAL


def test_weights_add_up_to_the_accumulated_alpha(baked, cameras):
    camera = next(iter(cameras.values())).resized(320, 213)
    equal = replace(baked, opacities=dict.fromkeys((RGB, THERMAL), baked.opacities[RGB]))
    weights = blending_weights(equal, [camera])
    torch.testing.assert_close(
        weights.sum(), equal.render(camera)[RGB].alpha.sum(), rtol=1e-3, atol=0
    )


def test_what_is_hidden_goes_first(baked, cameras):
    hidden = torch.zeros(600, dtype=torch.bool)
    hidden[::3] = True
    opacity = torch.where(hidden, 0.01, 0.9)
    model = replace(baked, opacities=dict.fromkeys((RGB, THERMAL), opacity))
    kept = most_visible(model, list(cameras.values()), 200)
    assert len(kept) == 200
    assert not hidden[kept].any()


def test_a_small_model_is_kept_whole(baked, cameras):
    assert torch.equal(most_visible(baked, list(cameras.values()), 600), torch.arange(600))
