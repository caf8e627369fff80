"""What a command says that torchrun has started in several processes."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from mrgs.app.cli import main
from mrgs.app.commands import Train
from mrgs.app.training import _require_possible
from mrgs.errors import ConfigError
from mrgs.runs.registry import find_method


@pytest.fixture
def as_process(monkeypatch):
    """As one of two processes."""

    def place(rank: int) -> None:
        variables = {"RANK": rank, "WORLD_SIZE": 2, "LOCAL_RANK": rank, "LOCAL_WORLD_SIZE": 2}
        for name, value in {"TORCHELASTIC_RUN_ID": "test", **variables}.items():
            monkeypatch.setenv(name, str(value))

    return place


def test_a_command_for_one_process_says_so_once(as_process, capsys, tmp_path):
    as_process(0)
    assert main(["eval", str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("mrgs: error: ")
    assert "torchrun" in line
    as_process(1)
    assert main(["eval", str(tmp_path)]) == 2
    assert capsys.readouterr() == ("", "")


def test_an_option_that_does_not_exist_is_named_once(as_process, capsys):
    as_process(1)
    with pytest.raises(SystemExit):
        main(["train", "scene", "--no-such-option"])
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        ("thermonerf", {}, "torchrun out"),
        ("mrgs", {"minutes": 2.0}, "use --max-steps"),
        ("thermonerf", {"batch": 2}, "--batch needs"),
    ],
)
def test_what_several_processes_cannot_do(method, options, message, tmp_path):
    command = Train(tmp_path, **options)
    with pytest.raises(ConfigError, match=message):
        _require_possible(command, find_method(method), SimpleNamespace(count=2))
