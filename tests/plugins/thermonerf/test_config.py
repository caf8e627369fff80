from __future__ import annotations

from dataclasses import replace

import pytest

from mrgs.errors import ConfigError
from mrgs_thermonerf import ThermoNerfConfig, from_yaml, make_config
from tests.helpers.thermonerf import small_config


def test_a_part_stands_over_another_configuration():
    base = small_config()
    changed = from_yaml("learning_rate: 0.02", "part.yaml", base)
    assert changed == replace(base, learning_rate=0.02)


def test_the_learning_rate_decays_from_one_end_to_the_other():
    config = ThermoNerfConfig(max_steps=100, learning_rate=1e-2, learning_rate_final=1e-4)
    rates = [config.learning_rate_at(step) for step in range(1, 101)]
    assert rates[-1] == pytest.approx(1e-4)
    assert rates[49] == pytest.approx(1e-3)
    assert rates == sorted(rates, reverse=True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("max_steps: 0", r"x\.yaml: max_steps .*not 0"),
        ("rays_per_batch: 0", r"x\.yaml: rays_per_batch .*not 0"),
        ("resolution: 3", r"x\.yaml: resolution .*not 3"),
        ("learning_rate_final: 1", r"x\.yaml: learning_rate_final .*1\.0"),
        ("method: mrgs", r"x\.yaml: method .*'mrgs'"),
    ],
)
def test_values_that_are_not_allowed_are_named(text, message):
    with pytest.raises(ConfigError, match=message):
        from_yaml(text, "x.yaml")


def test_text_that_is_not_yaml_is_named():
    with pytest.raises(ConfigError, match=r"x\.yaml .*YAML"):
        from_yaml("[", "x.yaml")


def test_a_preset_sets_steps_and_rays():
    config = make_config("paper", resolution=320, seed=3)
    assert (config.max_steps, config.rays_per_batch, config.resolution, config.seed) == (
        30_000,
        4_096,
        320,
        3,
    )
    assert make_config("fast", max_steps=7).max_steps == 7
    assert make_config() == ThermoNerfConfig()
    with pytest.raises(ConfigError, match=r"'slow'; .*fast, default, paper"):
        make_config("slow")
