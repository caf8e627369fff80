"""What leaving a Gaussian out changes: the estimate against rendering without it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mrgs import train
from mrgs.data import load_scene
from mrgs.method.losses.term import SceneScale
from mrgs.render import render
from mrgs.scene import RGB, THERMAL
from mrgs.training.removal import removal_errors
from mrgs.training.view_pass import PhotographedView
from tests.helpers.training import short_config

CALLS = 150


@pytest.mark.parametrize("method", ["mrgs-plus", "mrgs"])
def test_the_estimate_is_what_a_rendering_without_the_gaussian_differs_by(method, make_start):
    config = short_config(method)
    scene, state = make_start(config)
    view = scene.train[0]
    photos = {modality: image.load() for modality, image in view.images.items()}
    shown = [PhotographedView(0, view, photos)]
    scale = SceneScale.of(scene)
    estimates = [removal_errors(state, shown, config, scale) for _ in range(CALLS)]
    found = torch.stack(estimates).mean(dim=0)

    def images():
        with torch.no_grad():
            rendering, _ = render(state.model, view.cameras, {THERMAL: 0})
        return {each: rendering[each].image for each in (RGB, THERMAL)}

    whole, gaussians = images(), state.model.gaussians
    chosen = found.argsort(descending=True)[:12].tolist()
    for row in chosen:
        kept = {name: logits.detach().clone() for name, logits in gaussians.opacity_logits.items()}
        for logits in gaussians.opacity_logits.values():
            logits.data[row] = -30.0
        without = images()
        for name, logits in gaussians.opacity_logits.items():
            logits.data.copy_(kept[name])
        exact = sum(
            float((without[each] - whole[each]).square().sum())
            / float((whole[each] - photos[each].values).square().sum())
            for each in whole
        )
        assert float(found[row]) == pytest.approx(exact, rel=0.5)
    assert all(parameter.grad is None for parameter in state.parameters())


def test_a_training_grows_beyond_the_cap_and_ends_at_it(small_scene: Path, tmp_path: Path):
    scene = load_scene(small_scene)
    config = short_config("mrgs-plus", max_steps=30)
    density = config.densification
    steps = {"start": 2, "stop": 10, "every": 4, "gradient_threshold": 0.0, "overshoot": 3.0}
    start = len(scene.points.positions)
    density = type(density)(**steps, max_gaussians=start // 2)
    run = train(scene, tmp_path / "run", replace(config, densification=density))
    assert run.gaussian_count <= start // 2
    lines = (tmp_path / "run/log.jsonl").read_text().splitlines()
    counts = {
        line["step"]: line["gaussians"] for line in map(json.loads, lines) if "pruned" in line
    }
    assert max(counts.values()) > start
    assert [counts[step] for step in (11, 13, 15)] == sorted(
        (density.cap_at(step) for step in (11, 13, 15)), reverse=True
    )
