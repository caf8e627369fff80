from __future__ import annotations

from dataclasses import replace

import pytest

from mrgs.data import load_scene
from mrgs.training.config import make_config
from mrgs.training.memory import estimate_bytes, peak_memory_bytes


@pytest.mark.parametrize("method", ["mrgs", "3dgs-rgbt"])
def test_estimate_grows_with_the_cap_and_the_resolution(method, small_scene):
    scene = load_scene(small_scene)
    caps = [estimate_bytes(scene, make_config(method, max_gaussians=cap)) for cap in (1_000, 50_000, 1_000_000)]
    assert caps == sorted(set(caps))
    smaller = estimate_bytes(load_scene(small_scene, resolution=20), make_config(method, max_gaussians=1_000))
    assert smaller < caps[0]


def test_the_baseline_needs_less(small_scene):
    scene = load_scene(small_scene)
    assert estimate_bytes(scene, make_config("3dgs-rgbt")) < estimate_bytes(scene, make_config("mrgs"))


def test_without_densification_the_start_points_count(small_scene):
    scene = load_scene(small_scene)
    config = make_config("mrgs", max_gaussians=1_000_000)
    never = replace(config, densification=replace(config.densification, start=config.max_steps))
    assert estimate_bytes(scene, never) < estimate_bytes(scene, config)


def test_peak_is_that_of_a_process_with_torch_in_it():
    assert 50 * 2**20 < peak_memory_bytes() < 2**40
