"""The child's own code, in this process; ``test_processes`` starts real ones."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import pytest

from mrgs.comparison import child
from mrgs.comparison.methods import Variant, configure
from mrgs.errors import KernelWarning, MrgsWarning
from mrgs.system.strict_yaml import write_yaml
from tests.helpers.comparison import tiny_options


@pytest.fixture(autouse=True)
def at_home(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave this process's signals and standard input alone."""
    monkeypatch.setattr(child.signal, "signal", lambda *_: None)
    monkeypatch.setattr(child, "when_asked_to_stop", lambda action: None)


@pytest.fixture
def request_for(tmp_path: Path):
    def make(scene: Path) -> dict[str, str | None]:
        config = configure(Variant("3dgs-rgbt", "3dgs-rgbt"), tiny_options(), 0)
        return {
            "scene": str(scene), "folder": str(tmp_path / "run"), "config": write_yaml(config),
            "device": "cpu", "lpips_weights": None,
        }  # fmt: skip

    return make


def said(capsys: pytest.CaptureFixture[str]) -> list[dict]:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_a_kernel_that_differs_is_reported(small_scene, request_for, capsys, monkeypatch):
    def run_one(*_: object, **__: object) -> bool:
        warnings.warn("shade: the kernel differs", KernelWarning, stacklevel=1)
        warnings.warn("the scene has no points", MrgsWarning, stacklevel=1)
        return True

    monkeypatch.setattr(child, "run_one", run_one)
    assert child.main(request_for(small_scene)) == 0
    assert said(capsys)[0] == {"warning": "shade: the kernel differs"}


def test_a_run_is_followed_to_its_scores(small_scene, request_for, capsys):
    assert child.main(request_for(small_scene)) == 0
    messages = said(capsys)
    assert messages[0]["step"] == 1
    assert messages[-3:] == [{"scored": 1, "of": 2}, {"scored": 2, "of": 2}, {"end": "scored"}]


def test_what_the_user_can_mend_is_said_in_one_message(tmp_path, request_for, capsys):
    assert child.main(request_for(tmp_path / "nowhere")) == 2
    (message,) = said(capsys)
    assert message["end"] == "error"
    assert "nowhere: not a folder" in message["message"]


def test_the_end_of_input_stops_the_training_with_a_checkpoint(
    small_scene, request_for, capsys, monkeypatch
):
    monkeypatch.setattr(child, "when_asked_to_stop", lambda action: action())
    request = request_for(small_scene)
    assert child.main(request) == 0
    assert said(capsys)[-1] == {"end": "stopped"}
    assert [path.name for path in (Path(request["folder"]) / "checkpoints").iterdir()] == [
        "step_000001.safetensors"
    ]


def test_the_end_of_input_stops_the_scoring(small_scene, request_for, capsys, monkeypatch):
    send, stop = child.send, []

    def end_with_the_first_view(**message):
        send(**message)
        if message.get("scored") == 1:
            stop[0]()

    monkeypatch.setattr(child, "send", end_with_the_first_view)
    monkeypatch.setattr(child, "when_asked_to_stop", stop.append)
    request = request_for(small_scene)
    assert child.main(request) == 0
    assert said(capsys)[-2:] == [{"scored": 1, "of": 2}, {"end": "stopped"}]
    assert not (Path(request["folder"]) / "eval").exists()
