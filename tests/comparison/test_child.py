"""The child's own code, in this process; ``test_processes`` starts real ones."""

from __future__ import annotations

import json
import signal
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from mrgs.errors import KernelWarning, MrgsWarning
from mrgs.system.strict_yaml import write_yaml
from mrgs_compare import child
from mrgs_compare.plan import Variant, configure, run_one
from tests.helpers.comparison import tiny_options


@pytest.fixture(autouse=True)
def at_home() -> Iterator[None]:
    """This process's signals are as before when a test has ended."""
    names = [name for name in ("SIGINT", *child.REQUESTS) if hasattr(signal, name)]
    handlers = {number: signal.getsignal(number) for number in (getattr(signal, n) for n in names)}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


def deaf(action: Callable[[], None]) -> None:
    """Leave this process's standard input alone."""


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


def test_a_kernel_that_differs_is_reported(small_scene, request_for, capsys):
    def run(*_: object, **__: object) -> bool:
        warnings.warn("shade differs", KernelWarning, stacklevel=1)
        warnings.warn("the scene has no points", MrgsWarning, stacklevel=1)
        return True

    assert child.main(request_for(small_scene), run, listen=deaf) == 0
    assert said(capsys)[0] == {"warning": "shade differs"}


def test_a_run_is_followed_to_its_scores(small_scene, request_for, capsys):
    assert child.main(request_for(small_scene), listen=deaf) == 0
    messages = said(capsys)
    assert messages[0]["step"] == 1
    assert messages[-3:] == [{"scored": 1, "of": 2}, {"scored": 2, "of": 2}, {"end": "scored"}]


def test_what_the_user_can_mend_is_said_in_one_message(tmp_path, request_for, capsys):
    assert child.main(request_for(tmp_path / "nowhere"), listen=deaf) == 2
    (message,) = said(capsys)
    assert message["end"] == "error"
    assert "nowhere: not" in message["message"]


def asked_to_stop(request: dict[str, str | None], after: str) -> int:
    """Have a child asked to stop once it has done its first step, or scored its first view."""
    stop: list[Callable[[], None]] = []

    def run(*arguments: Any, on_step: Any, on_score: Any, **options: Any) -> bool:
        def step(statistics: Any) -> bool:
            on_step(statistics)
            if after == "step":
                stop[0]()
            return on_step(statistics)

        def score(done: int, total: int) -> None:
            if after == "score":
                stop[0]()
            on_score(done, total)

        return run_one(*arguments, on_step=step, on_score=score, **options)

    return child.main(request, run, listen=stop.append)


def test_the_end_of_input_stops_the_training_with_a_checkpoint(small_scene, request_for, capsys):
    request = request_for(small_scene)
    assert asked_to_stop(request, after="step") == 0
    assert said(capsys)[-1] == {"end": "stopped"}
    assert [path.name for path in (Path(request["folder"]) / "checkpoints").iterdir()] == [
        "step_000001.safetensors"
    ]


def test_the_end_of_input_stops_the_scoring(small_scene, request_for, capsys):
    request = request_for(small_scene)
    assert asked_to_stop(request, after="score") == 0
    assert said(capsys)[-2:] == [{"scored": 1, "of": 2}, {"end": "stopped"}]
    assert not (Path(request["folder"]) / "eval").exists()
