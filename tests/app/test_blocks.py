from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from mrgs.app.cli import main
from mrgs.runs import registry
from mrgs.runs.open import load_run
from mrgs.runs.registry import find_method
from mrgs.training import train
from tests.helpers.scenes import write_scene

SHORT = ("--preset", "fast", "--max-steps", "3", "--max-gaussians", "200")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene"))


def run(scene: Path, folder: Path, *options: str) -> int:
    return main(["train", str(scene), "--output", str(folder), *SHORT, *options])


@pytest.mark.slow
def test_blocks_are_trained_one_by_one_and_joined(scene, tmp_path, capsys):
    blocks = ("--blocks", "1x2", "--overlap", "0.1")
    assert run(scene, tmp_path, *blocks, "--block", "2") == 0
    assert "blocks left: 1" in capsys.readouterr().out
    assert run(scene, tmp_path, *blocks) == 0
    out = capsys.readouterr().out
    assert re.search(r"^block 1 of 2, \d photos:$", out, re.MULTILINE)
    assert f"eval {tmp_path}" in out
    assert load_run(tmp_path).facts.step == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--overlap", "2"), "need --blocks"),
        (("--block", "2"), "need --blocks"),
        (("--blocks", "two"), "ROWSxCOLUMNS"),
        (("--blocks", "auto", "--tensorboard"), "--tensorboard"),
        (("--blocks", "auto", "--view"), "--view"),
        (("--blocks", "auto", "--batch", "2"), "--batch"),
        (("--blocks", "auto", "--eval-steps", "2"), "--eval-steps"),
    ],
)
def test_options_that_do_not_go_together_are_refused(scene, tmp_path, capsys, options, message):
    assert run(scene, tmp_path / "run", *options) == 2
    error = capsys.readouterr().err
    assert error.startswith("mrgs: error: ")
    assert error.count("\n") == 1
    assert message in error
    assert not (tmp_path / "run").exists()


def test_a_method_with_a_training_of_its_own_is_refused(scene, tmp_path, capsys, monkeypatch):
    method = replace(find_method("mrgs-plus"), train=partial(train, terms=[]))
    monkeypatch.setitem(registry._METHODS, "mrgs-plus", method)
    assert run(scene, tmp_path / "run", "--blocks", "1x2", "--overlap", "0.1") == 2
    error = capsys.readouterr().err
    assert "mrgs-plus" in error
    assert "in blocks" in error
