"""A strategy, a term and a method of one's own, given from Python."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import dataclass, replace
from enum import Enum, auto
from functools import partial
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from torch import nn

import mrgs
from mrgs import Method, Strategy, Term, load_run, make_config, open_run, register
from mrgs.errors import ConfigError, RunError
from mrgs.evaluation import evaluate_run
from mrgs.method.config import METHODS
from mrgs.method.density import DensityUpdate
from mrgs.run_files.checkpoint import read, write_file
from mrgs.runs import registry
from mrgs.runs.registry import find_method, registered_methods
from mrgs.system.strict_yaml import write_yaml
from mrgs.training import train
from mrgs.training.start import Hooks, TrainOptions
from tests.helpers.training import short_config

RESUME = TrainOptions(resume=True)


@dataclass(frozen=True)
class Duplicate(Strategy):
    """Doubles a Gaussian drawn by chance every few steps, and counts the views that drew each."""

    every: int = 4

    def initial_state(self, gaussians):
        return {"drawn": torch.zeros(len(gaussians))}

    def observe(self, passes):
        return {"drawn": sum((points.radii > 0).float() for points in passes)}

    def after_step(self, state, optimizer, step):
        drawn = state["drawn"] + step.observed["drawn"]
        gaussians = optimizer.gaussians
        if step.number % self.every > 0 or len(gaussians) >= self.max_gaussians:
            return DensityUpdate({"drawn": drawn})
        chosen = torch.randint(len(gaussians), (1,), generator=step.generator)
        rows = {name: tensor.detach()[chosen] for name, tensor in gaussians.tensors().items()}
        optimizer.replace_rows(torch.arange(len(gaussians)), gaussians.with_tensors(rows))
        return DensityUpdate({"drawn": torch.cat([drawn, drawn[chosen]])}, {"doubled": 1})


@dataclass(frozen=True)
class Blind(Strategy):
    """Keeps all as it is."""

    def after_step(self, state, optimizer, step):
        assert dict(step.observed) == {}
        return DensityUpdate(state)


class Sizes(Term):
    """Mean size of the Gaussians, times a factor that is learned."""

    name = "sizes"
    learning_rate = 0.1

    def __init__(self):
        self.learned = nn.Linear(1, 1, bias=False)
        nn.init.constant_(self.learned.weight, 0.5)

    def weight(self, step):
        return 1e-3 * step

    def value(self, context):
        mean = context.gaussians.scales.mean() / context.scale.extent
        return self.learned(mean[None])[0] ** 2


class DarkPhotos(Term):
    """Takes the place of L_t, and has nothing to say."""

    name = "thermal"

    def value(self, context):
        return None


def log_of(folder):
    return [json.loads(line) for line in folder.log_file.read_text().splitlines()]


def assert_same(first, second):
    expected, found = (load_file(folder.newest_checkpoint()) for folder in (first, second))
    assert set(found) == set(expected)
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []


def test_a_strategy_of_ones_own_trains_logs_resumes_and_opens(small_scene, tmp_path):
    config = short_config(max_steps=12)
    mine = Duplicate(every=4, max_gaussians=27)
    whole = train(small_scene, tmp_path / "whole", config, strategy=mine)
    parts = train(small_scene, tmp_path / "parts", config, strategy=mine, stop_at=6)
    train(small_scene, parts.path, config, options=RESUME, strategy=mine)
    assert_same(whole, parts)
    assert load_file(whole.newest_checkpoint())["strategy.drawn"].max() == 12
    events = [entry for entry in log_of(whole) if "doubled" in entry]
    assert events == [
        {"step": 4, "doubled": 1, "gaussians": 26},
        {"step": 8, "doubled": 1, "gaussians": 27},
    ]
    assert open_run(whole.path).gaussian_count == 27


def test_the_cap_of_a_strategy_holds_at_the_start(small_scene, tmp_path):
    folder = train(
        small_scene, tmp_path, short_config(max_steps=1), strategy=Blind(max_gaussians=9)
    )
    assert open_run(folder.path).gaussian_count == 9
    with pytest.raises(ConfigError, match="max_gaussians"):
        Blind(max_gaussians=0)


def test_a_term_of_ones_own_is_weighed_learned_logged_and_saved(small_scene, tmp_path):
    config = short_config(max_steps=10)
    statistics = []
    whole = train(
        small_scene,
        tmp_path / "whole",
        config,
        hooks=Hooks(on_step=statistics.append),
        terms=[Sizes()],
    )
    parts = train(small_scene, tmp_path / "parts", config, terms=[Sizes()], stop_at=4)
    train(small_scene, parts.path, config, options=RESUME, terms=[Sizes()])
    assert_same(whole, parts)
    assert load_file(whole.newest_checkpoint())["terms.sizes.weight"].item() < 0.5
    terms = statistics[-1].terms
    assert list(terms) == ["rgb", "thermal", "smooth", "boltzmann", "sizes"]
    assert log_of(whole)[-1]["loss_sizes"] == pytest.approx(terms["sizes"])
    weights = dict.fromkeys(("rgb", "thermal"), 1.0)
    weights |= {"smooth": config.loss.smooth, "sizes": 0.01}
    rest = statistics[-1].loss - sum(weights[name] * terms[name] for name in weights)
    assert 0.01 - 1e-4 < rest / terms["boltzmann"] < 0.05 + 1e-4


def test_a_term_takes_the_place_of_one_of_its_name(small_scene, tmp_path):
    statistics = []
    train(
        small_scene,
        tmp_path,
        short_config("3dgs-rgbt", max_steps=2),
        hooks=Hooks(on_step=statistics.append),
        terms=[DarkPhotos()],
    )
    assert set(statistics[0].terms) == {"rgb"}


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"terms": [Sizes()]}, "Duplicate, not AdaptiveDensityControl"),
        ({"strategy": Duplicate()}, r"terms .*'sizes'\], not"),
    ],
)
def test_a_run_goes_on_with_what_it_began_with(options, named, small_scene, tmp_path):
    config = short_config(max_steps=3)
    train(small_scene, tmp_path, config, strategy=Duplicate(), terms=[Sizes()], stop_at=1)
    with pytest.raises(RunError, match=named):
        train(small_scene, tmp_path, config, options=RESUME, **options)


def test_a_run_goes_on_with_the_settings_of_a_strategy_that_it_began_with(small_scene, tmp_path):
    config = short_config(max_steps=3)
    train(small_scene, tmp_path, config, strategy=Duplicate(every=2), stop_at=1)
    with pytest.raises(RunError, match="Duplicate's every 2, not 3"):
        train(small_scene, tmp_path, config, options=RESUME, strategy=Duplicate(every=3))
    train(small_scene, tmp_path, config, options=RESUME, strategy=Duplicate(every=2))


def test_settings_of_the_configuration_may_be_changed_in_its_file(small_scene, tmp_path):
    config = short_config(max_steps=3)
    train(small_scene, tmp_path, config, stop_at=1)
    fewer = replace(config, densification=replace(config.densification, max_gaussians=40))
    (tmp_path / "config.yaml").write_text(write_yaml(fewer))
    train(small_scene, tmp_path, config, options=RESUME)


@dataclass(frozen=True)
class Composed(Blind):
    """Holds settings that are more than a number."""

    inner: Strategy = Blind()
    share: float = 0.5
    grows: bool = True
    name: str = "composed"
    until: int | None = None


def test_what_a_strategy_states_of_its_settings():
    expected = {"share": 0.5, "grows": True, "name": "composed", "until": None}
    settings = Composed(max_gaussians=7).settings()
    assert settings == {"max_gaussians": 7, "inner": Blind(), **expected}


class Kind(Enum):
    NEAR = auto()
    FAR = auto()


@dataclass(frozen=True)
class Anything(Blind):
    """Takes a setting of any kind."""

    setting: Any = None


@pytest.mark.parametrize(
    ("before", "same", "other"),
    [
        (float("nan"), float("nan"), 1.0),
        ((1, 2), (1, 2), (1, 3)),
        (Kind.NEAR, Kind.NEAR, Kind.FAR),
        (Blind(), Blind(), Blind(max_gaussians=7)),
        ("a" * 200, "a" * 200, "b" * 200),
    ],
)
def test_settings_of_any_kind_are_compared(before, same, other, small_scene, tmp_path):
    config = short_config(max_steps=2)
    train(small_scene, tmp_path, config, strategy=Anything(setting=before), stop_at=1)
    with pytest.raises(RunError, match="setting") as caught:
        train(small_scene, tmp_path, config, options=RESUME, strategy=Anything(setting=other))
    assert len(caught.value.message) < len(str(tmp_path)) + 400
    train(small_scene, tmp_path, config, options=RESUME, strategy=Anything(setting=same))


def test_a_setting_without_a_text_of_its_own_is_not_compared(small_scene, tmp_path):
    config = short_config(max_steps=2)
    train(small_scene, tmp_path, config, strategy=Anything(setting=object()), stop_at=1)
    train(small_scene, tmp_path, config, options=RESUME, strategy=Anything(setting=lambda: 0))


@pytest.mark.parametrize("said", [{}, {"strategy_settings": {"renamed": 1}}])
def test_a_checkpoint_that_does_not_say_a_setting_is_resumed(said, small_scene, tmp_path):
    config = short_config(max_steps=3)
    folder = train(small_scene, tmp_path, config, strategy=Duplicate(), stop_at=1)
    tensors, _, header = read(folder.newest_checkpoint())
    del header["strategy_settings"]
    write_file(folder.newest_checkpoint(), tensors, {**header, **said})
    train(small_scene, tmp_path, config, options=RESUME, strategy=Duplicate(every=2))


@pytest.fixture
def own_methods(monkeypatch):
    """What a test registers is forgotten after it."""
    monkeypatch.setattr(registry, "_METHODS", dict(registry._METHODS))


def doubling() -> Method:
    return Method(
        "doubling",
        "3DGS_RGB-T that doubles Gaussians by chance",
        partial(make_config, "3dgs-rgbt"),
        train=partial(train, strategy=Duplicate(every=2)),
    )


def test_a_registered_method_is_configured_trained_opened_and_scored(
    small_scene, tmp_path, own_methods, monkeypatch
):
    register(doubling())
    method = find_method("doubling")
    config = method.configure("fast", max_steps=4, max_gaussians=50, changes="{seed: 3}")
    assert (config.method, config.seed, config.shares_opacity) == ("doubling", 3, True)
    method.train(small_scene, tmp_path, config, stop_at=2)
    method.train(small_scene, tmp_path, config, options=RESUME)
    run = load_run(tmp_path)
    assert (run.config, run.gaussian_count, run.facts.step) == (config, 27, 4)
    evaluate_run(run)
    assert json.loads((tmp_path / "eval/metrics.json").read_text())["method"] == "doubling"
    monkeypatch.delitem(registry._METHODS, "doubling")
    with pytest.raises(RunError, match="'doubling'"):
        open_run(tmp_path)


def test_a_preset_among_the_changes_brings_all_of_its_values():
    method = find_method("mrgs")
    changes = "{preset: paper, field: {neighbours_n: 5}}"
    config = method.configure("fast", changes=changes, source="changes.yaml")
    paper = make_config("mrgs", "paper")
    assert config == replace(paper, field=replace(paper.field, neighbours_n=5))
    with pytest.raises(ConfigError, match="preset 'slow'"):
        method.configure(changes="preset: slow")
    with pytest.raises(ConfigError, match="is for the method") as told:
        method.configure(changes=f"method: {5_000 * 'x'}", source="changes.yaml")
    assert len(str(told.value)) < 300


@pytest.mark.parametrize(
    "values", [{"max_steps": 200}, {"batch": 4}, {"max_steps": 90, "batch": 3}]
)
def test_steps_and_batch_in_a_file_rescale_the_schedule_as_options_do(values):
    method = find_method("mrgs")
    file = "\n".join(f"{name}: {value}" for name, value in values.items())
    assert method.configure("fast", changes=file) == method.configure("fast", **values)
    with pytest.raises(ConfigError, match="max_steps"):
        method.configure("fast", changes="max_steps: many")


def test_the_command_line_knows_a_registered_method(small_scene, tmp_path, own_methods, capsys):
    from mrgs.app.cli import main

    register(doubling())
    options = ["--output", str(tmp_path / "run"), "--preset", "fast"]
    command = ["train", str(small_scene), "--method", "doubling", *options, "--max-steps", "2"]
    assert main(command) == 0
    assert load_run(tmp_path / "run").gaussian_count == 26
    assert "doubling, 2 steps" in capsys.readouterr().out
    (tmp_path / "other.yaml").write_text("method: mrgs")
    command[command.index(str(tmp_path / "run"))] = str(tmp_path / "other")
    assert main([*command, "--config", str(tmp_path / "other.yaml")]) == 2
    assert re.search("other.yaml .*'mrgs', not doubling", capsys.readouterr().err)


def test_an_installed_package_may_offer_a_method(tmp_path, own_methods, monkeypatch):
    (tmp_path / "offered.py").write_text(
        "from mrgs import Method, make_config\n"
        "OFFERED = Method('offered', 'of a plugin', make_config)\n"
    )
    info = tmp_path / "offered-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: offered\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[mrgs.methods]\noffered = offered:OFFERED\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert find_method("offered").configure().method == "offered"
    monkeypatch.delitem(sys.modules, "offered")


def test_every_method_of_the_paper_is_registered_and_described():
    assert [method.name for method in registered_methods() if method.has_gaussians] == sorted(
        METHODS, key=[method.name for method in registered_methods()].index
    )
    assert {method.name for method in registered_methods()} - set(METHODS) == {"thermonerf"}
    for method in registered_methods():
        assert method.description
        config = method.configure("fast", max_steps=7, resolution=64, seed=2)
        assert (config.method, config.max_steps) == (method.name, 7)
        assert (config.resolution, config.seed) == (64, 2)
        again = replace(config, seed=9)
        assert method.read_config("seed: 9", "x.yaml", config) == again


def test_what_extends_the_package_is_exported():
    assert {"Method", "Strategy", "Term", "register"} <= set(mrgs.__all__)
    assert all(getattr(mrgs, name) is not None for name in mrgs.__all__)
