from __future__ import annotations

import dataclasses
import re
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrgs.errors import ConfigError
from mrgs.field import FieldConfig
from mrgs.method.camera_model.image_model import ImageModelConfig
from mrgs.method.config import METHODS, PRESETS, TrainConfig, from_yaml, make_config
from mrgs.method.density import AdaptiveDensityControl
from mrgs.method.losses.photometric import LossConfig
from mrgs.method.losses.radiation import RadiationConfig
from mrgs.method.optimizer import OptimizerConfig
from mrgs.system.strict_yaml import write_yaml

COUNTS = st.integers(1, 10**9)
WEIGHTS = st.floats(0, 1e6, allow_subnormal=True)
RATES = st.floats(1e-12, 10)

CONFIGS = st.builds(
    TrainConfig,
    method=st.sampled_from(METHODS),
    preset=st.sampled_from(PRESETS),
    max_steps=COUNTS,
    resolution=st.none() | st.integers(16, 10**5),
    seed=st.integers(0, 2**32 - 1),
    sh_every=COUNTS,
    shares_opacity=st.booleans(),
    field=st.builds(
        FieldConfig, fourier=st.booleans(), neighbours_n=st.integers(1, 9), anchor_weight=WEIGHTS
    ),
    loss=st.builds(LossConfig, dssim=st.floats(0, 1), smooth=WEIGHTS),
    radiation=st.none()
    | st.builds(RadiationConfig, start=RATES, end=RATES, decay_from=st.integers(0, 14_999)),
    optimizer=st.builds(OptimizerConfig, means=RATES, means_final=RATES, heads=RATES),
    image_model=st.builds(ImageModelConfig, point_spread=st.booleans(), thermal_gain_rate=RATES),
    densification=st.builds(
        AdaptiveDensityControl, every=COUNTS, max_gaussians=COUNTS, gradient_threshold=WEIGHTS
    ),
)


@pytest.mark.filterwarnings("ignore:Do not use the `random` module")  # the type checker's samples
@settings(max_examples=50)
@given(CONFIGS)
def test_yaml_gives_back_the_same_configuration(config):
    assert from_yaml(write_yaml(config), "config.yaml") == config


def test_yaml_shows_every_field():
    text = write_yaml(TrainConfig())
    names = [field.name for field in dataclasses.fields(TrainConfig)]
    names += [field.name for field in dataclasses.fields(AdaptiveDensityControl)]
    assert all(f"{name}:" in text for name in names)


REFUSED = {
    "max_stepps: 5": "max_stepps.*max_steps",
    "loss: {smoth: 1.0}": "loss: .*smoth.*smooth",
    "max_steps: many": "max_steps .*int.*many",
    "max_steps: 5.5": "max_steps .*int.*5.5",
    "max_steps: true": "max_steps .*int.*True",
    "shares_opacity: 1": "shares_opacity .*bool.*1",
    "loss: {dssim: [1]}": r"loss: dssim .*float.*\[1\]",
    "loss: 3": "loss .*fields",
    "method: 3": "method .*str.*3",
    "preset: [fast]": r"preset .*default.*\['fast'\]",
    "max_steps: 0": "max_steps .*1, not 0",
    "loss: {dssim: 2}": "loss: dssim .*2.0",
    "- a\n- b": "fields",
    "": "fields",
    "a: [": "YAML",
    "seed: 1\nseed: 2": "YAML.*'seed'",
    "loss: {dssim: 0, dssim: 1}": "YAML.*'dssim'",
    "seed: -1": "seed .*0, not -1",
    "loss: {smooth: .nan}": "loss: smooth .*finite.*nan",
    "loss: {smooth: .inf}": "loss: smooth .*finite.*inf",
    f"loss: {{smooth: {10**400}}}": "loss: smooth .*finite",
    "seed: 0x" + 5000 * "f": "seed .*4,294,967,295",
    "temperature_sh_degree: 0x" + 5000 * "f": "temperature_sh_degree .*0 to 3",
    "field: {embedding_width: 0x" + 5000 * "f" + "}": "field: embedding_width .*multiple of 6",
    "resolution: -0x" + 5000 * "f": "resolution .*16 px",
    "densification: {start: -5}": "densification: start",
    "a: !!python/object/apply:os.getcwd []": "YAML",
}


def test_what_cannot_be_used_is_named():
    for text, named in REFUSED.items():
        with pytest.raises(ConfigError) as caught:
            from_yaml(text, "config.yaml")
        message = str(caught.value)
        assert re.match(f"config.yaml.*{named}", message), (text[:40], message)
        assert "\n" not in message, text[:40]


@given(
    st.text()
    | st.recursive(
        st.none() | st.integers() | st.text(), lambda s: st.dictionaries(st.text(), s)
    ).map(str)
)
def test_any_text_gives_a_configuration_or_a_config_error(text):
    with suppress(ConfigError):
        assert isinstance(from_yaml(text, "config.yaml"), TrainConfig)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"method": "nerf"}, "method 'nerf'.*mrgs-fourier"),
        ({"preset": "slow"}, "preset 'slow'.*paper"),
        ({"max_steps": 0}, "max_steps .* 0"),
        ({"resolution": 8}, "resolution .* 8"),
        ({"max_gaussians": 0}, "max_gaussians .* 0"),
    ],
)
def test_impossible_choices_are_named(options, named):
    with pytest.raises(ConfigError, match=named):
        make_config(**options)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"neighbours_every": 0}, "neighbours_every .* 0"),
        ({"temperature_sh_degree": 4}, "temperature_sh_degree .* 4"),
        ({"dilation_px2": 0.0}, "dilation_px2 .* 0"),
        ({"dilation_px2": 2.0}, "dilation_px2 .* 2"),
    ],
)
def test_impossible_fields_are_named(options, named):
    with pytest.raises(ConfigError, match=named):
        replace(TrainConfig(), **options)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("method", METHODS)
def test_every_method_and_preset_is_valid(method, preset):
    config = make_config(method, preset)
    assert (config.method, config.preset) == (method, preset)
    schedule = config.densification
    assert 0 < schedule.start < schedule.stop < config.max_steps
    assert from_yaml(write_yaml(config), "config.yaml") == config


def test_methods_are_the_rows_of_the_ablation_table():
    rows = {method: make_config(method) for method in METHODS}
    table = {
        method: (
            config.field.residuals,
            config.field.neighbours_k > 0,
            config.radiation is not None,
        )
        for method, config in rows.items()
    }
    assert table == {
        "mrgs": (True, True, True),
        "mrgs-base": (True, False, False),
        "mrgs-fourier": (True, True, False),
        "mrgs-boltz": (True, False, True),
        "3dgs-rgbt": (False, False, False),
        "mrgs-plus": (False, False, False),
    }
    baseline = rows.pop("3dgs-rgbt")
    assert (baseline.shares_opacity, baseline.temperature_sh_degree, baseline.loss.smooth) == (
        True,
        3,
        0.0,
    )
    plus = rows.pop("mrgs-plus")
    assert (plus.temperature_sh_degree, plus.dilation_px2, plus.angular_dilation) == (
        None,
        0.1,
        True,
    )
    assert all(
        (config.shares_opacity, config.temperature_sh_degree) == (False, 0)
        for config in rows.values()
    )
    assert plus.densification.split_longest
    assert not any(each.densification.split_longest for each in (baseline, *rows.values()))
    assert all(
        (config.dilation_px2, config.angular_dilation) == (0.3, False)
        for config in (baseline, *rows.values())
    )


def test_mrgs_plus_starts_and_smooths_alike_in_all_presets():
    found = [make_config("mrgs-plus", preset) for preset in PRESETS]
    assert len({each.loss for each in found}) == 1
    assert all(each.distant_points and each.photo_temperatures for each in found)
    published = make_config("mrgs", "paper")
    assert (published.distant_points, published.photo_temperatures) == (False, False)
    assert published.loss == LossConfig()


def test_paper_is_the_published_schedule():
    config = make_config("mrgs", preset="paper")
    schedule, radiation = config.densification, config.radiation
    assert (config.max_steps, config.sh_every) == (30_000, 1_000)
    assert (schedule.start, schedule.stop, schedule.every, schedule.reset_every) == (
        500,
        15_000,
        100,
        3_000,
    )
    assert (radiation.start, radiation.end, radiation.decay_from, radiation.decay_until) == (
        0.05,
        0.01,
        500,
        15_000,
    )
    assert config.loss.smooth == 0.6


def test_max_steps_scales_the_schedule():
    config = make_config("mrgs", preset="paper", max_steps=3_000)
    schedule, radiation = config.densification, config.radiation
    assert (config.max_steps, config.sh_every) == (3_000, 100)
    assert (schedule.start, schedule.stop) == (50, 1_500)
    assert (schedule.every, schedule.reset_every) == (
        100,
        3_000,
    )  # opacities need these steps to recover
    assert (radiation.decay_from, radiation.decay_until) == (50, 1_500)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("steps", [1, 2, 7, 100_000])
def test_any_number_of_steps_gives_a_valid_schedule(method, steps):
    assert make_config(method, max_steps=steps).max_steps == steps


def test_degrees_come_one_by_one():
    config = replace(TrainConfig(), sh_every=10)
    assert [config.sh_degree_at(step) for step in (0, 9, 10, 19, 20, 30, 1_000)] == [
        0,
        0,
        1,
        1,
        2,
        3,
        3,
    ]


def test_a_part_of_a_configuration_goes_over_another():
    base = make_config("mrgs", "fast")
    changed = from_yaml("field: {neighbours_n: 5}\nradiation: null\nseed: 7\n", "my.yaml", base)
    assert changed == replace(
        base, field=replace(base.field, neighbours_n=5), radiation=None, seed=7
    )


def test_a_part_can_bring_back_what_the_method_left_out():
    base = make_config("mrgs-base")
    changed = from_yaml("radiation: {start: 0.2}", "my.yaml", base)
    assert changed.radiation is not None
    assert changed.radiation.start == 0.2


def test_a_part_with_a_misspelt_field_names_it():
    with pytest.raises(ConfigError, match=r"my\.yaml.*neighbors_n"):
        from_yaml("field: {neighbors_n: 5}", "my.yaml", make_config("mrgs"))


@pytest.mark.parametrize(("steps", "fit"), [(20, 20), (300, 300), (4_000, 300)])
def test_the_fit_before_a_training_takes_no_more_steps_than_the_training(steps, fit):
    assert make_config("mrgs", "fast", max_steps=steps).fitted_residuals == fit


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_steps", 2.5),
        ("max_gaussians", "20"),
        ("resolution", 320.0),
        ("seed", None),
        ("batch", 1.5),
    ],
)
def test_what_must_be_whole_numbers_is_named(name, value):
    with pytest.raises(ConfigError, match=f"{name} .*whole number"):
        make_config(**{name: value})


def test_whole_numbers_may_be_of_any_type():
    config = make_config("mrgs", max_steps=np.int64(7), seed=np.uint8(3))
    assert from_yaml(write_yaml(config), "config.yaml") == config


def test_steps_of_several_views_are_fewer_and_longer():
    one, four = make_config("mrgs-plus"), make_config("mrgs-plus", batch=4)
    assert four.max_steps == one.max_steps / 4
    assert four.optimizer.means == pytest.approx(2 * one.optimizer.means)
    assert four.optimizer.means_final == pytest.approx(2 * one.optimizer.means_final)
    assert four.optimizer.heads == pytest.approx(2 * one.optimizer.heads)
    assert four.optimizer.slowdown_at(1) == one.optimizer.slowdown_at(1)
    assert four.image_model.poses_rate == pytest.approx(2 * one.image_model.poses_rate)
