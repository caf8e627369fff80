"""The method comes in by its package's entry point, and its absence is named."""

from __future__ import annotations

from collections.abc import Callable

import pytest

import mrgs_thermonerf
from mrgs import open_run
from mrgs.app.cli import main
from mrgs.errors import RunError
from mrgs.runs import registry
from mrgs.runs.registry import find_method, registered_methods
from tests.helpers.thermonerf import small_config


@pytest.fixture
def uninstall(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Hides the entry points of all packages, and forgets the method, for the rest of a test."""

    def hide() -> None:
        registered_methods()
        monkeypatch.delitem(registry._METHODS, "thermonerf")
        monkeypatch.setattr(registry, "PLUGINS", "mrgs.hidden")

    return hide


def test_the_entry_point_offers_the_method():
    assert find_method("thermonerf") is mrgs_thermonerf.METHOD
    assert {"METHOD", "ThermoNerfRun", "train_thermonerf"} <= set(mrgs_thermonerf.__all__)
    assert all(getattr(mrgs_thermonerf, name) for name in mrgs_thermonerf.__all__)


@pytest.mark.parametrize("command", ["train", "compare"])
def test_the_package_is_named_where_it_is_not_installed(
    command, small_scene, tmp_path, capsys, uninstall
):
    uninstall()
    option = "--method" if command == "train" else "--methods"
    output = tmp_path / "new"
    assert main([command, str(small_scene), option, "thermonerf", "--output", str(output)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("mrgs: error: ")
    assert "mrgs-thermonerf" in line
    assert "pip install ./plugins/thermonerf" in line
    assert not output.exists()


def test_a_run_of_it_names_the_package_too(small_scene, tmp_path, capsys, uninstall):
    path = tmp_path / "run"
    mrgs_thermonerf.train_thermonerf(small_scene, path, small_config(1))
    uninstall()
    with pytest.raises(RunError, match=r"is a run .*mrgs-thermonerf"):
        open_run(path)
    assert main(["eval", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert str(path) in line
    assert "pip install ./plugins/thermonerf" in line
