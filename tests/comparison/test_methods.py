from __future__ import annotations

import pytest

from mrgs.comparison.methods import configure, from_text, read_config, to_text, train_run
from mrgs.comparison.single import flat
from mrgs.errors import ConfigError
from mrgs.training.run_folder import RunFolder


def test_the_number_of_neighbours_is_all_that_changes(make_options):
    options = make_options()
    usual, other = flat(configure("mrgs", options, 4)), flat(configure("mrgs", options, 4, neighbours_n=5))
    assert {name for name in usual if usual[name] != other[name]} == {"field.neighbours_n"}
    assert (usual["seed"], usual["max_steps"], usual["densification.max_gaussians"]) == (4, 3, 60)


@pytest.mark.parametrize(("method", "n"), [("mrgs", 5), ("3dgs-rgbt", None), ("thermonerf", None)])
def test_a_configuration_survives_its_text(method, n, make_options):
    config = configure(method, make_options(), 1, neighbours_n=n)
    assert from_text(to_text(config)) == config
    with pytest.raises(ConfigError, match="the request must hold the fields of a configuration"):
        from_text("3")


@pytest.mark.parametrize("method", ["3dgs-rgbt", "thermonerf"])
def test_every_method_is_trained_continued_and_read_back(method, small_scene, tmp_path, make_options):
    config = configure(method, make_options(), 0)
    train_run(small_scene, tmp_path, config, lambda statistics: statistics.step == 2)
    steps = []
    train_run(small_scene, tmp_path, config, lambda statistics: steps.append(statistics.step))
    assert steps == [3]
    assert read_config(RunFolder(tmp_path)) == config
