from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from mrgs.errors import RunError
from mrgs.training.config import TrainConfig, make_config
from mrgs.training.run_folder import RunFolder


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    folder = RunFolder(tmp_path / "run")
    folder.start(TrainConfig())
    return folder


def touch_checkpoints(folder: RunFolder, *steps: int) -> None:
    for step in steps:
        folder.checkpoint_file(step).parent.mkdir(exist_ok=True)
        folder.checkpoint_file(step).touch()


def test_a_new_run_keeps_its_configuration(tmp_path):
    config = make_config("3dgs-rgbt", "fast", seed=7)
    folder = RunFolder(tmp_path / "a" / "b")
    folder.start(config)
    assert folder.read_config() == config
    assert folder.checkpoints() == []


def test_a_run_is_not_started_twice(folder):
    with pytest.raises(
        RunError, match="run already holds a run: continue it with --resume, or choose another --output"
    ):
        folder.start(TrainConfig())


def test_checkpoints_are_sorted_by_step_and_the_newest_two_are_kept(folder):
    touch_checkpoints(folder, 2_000_000, 1_000, 999_999)
    assert folder.newest_checkpoint() == folder.checkpoint_file(2_000_000)
    folder.drop_old_checkpoints()
    assert folder.checkpoints() == [folder.checkpoint_file(999_999), folder.checkpoint_file(2_000_000)]
    folder.drop_old_checkpoints()
    assert len(folder.checkpoints()) == 2


def test_other_files_are_no_checkpoints(folder):
    touch_checkpoints(folder, 5)
    (folder.path / "checkpoints" / ".step_000009.12.safetensors").touch()
    (folder.path / "checkpoints" / "step_000009.txt").touch()
    assert folder.checkpoints() == [folder.checkpoint_file(5)]


def test_what_is_not_a_run_is_named(tmp_path, folder):
    empty = RunFolder(tmp_path)
    with pytest.raises(RunError, match=r"is not a run: it has no config\.yaml; name a folder that `mrgs train` wrote"):
        empty.newest_checkpoint()
    with pytest.raises(RunError, match=r"is not a run: its config\.yaml cannot be read; name a folder that"):
        empty.read_config()
    with pytest.raises(RunError, match="run has no checkpoint yet: let it train, or delete it and train anew"):
        folder.newest_checkpoint()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\xff\xfe", r"its config\.yaml cannot be read"),
        (b"max_steps: 0", r"config\.yaml: max_steps must be at least 1, not 0; mend the file or train anew"),
        (b"steps: 7", r"config\.yaml: there is no field 'steps'; .*; mend the file or train anew"),
    ],
)
def test_a_damaged_configuration_is_named(content, message, folder):
    folder.config_file.write_bytes(content)
    with pytest.raises(RunError, match=message):
        folder.read_config()


def test_the_log_is_cut_behind_a_step(folder):
    folder.cut_log(5)  # no log yet
    for step in (1, 2, 2, 3):
        folder.append_log({"step": step, "loss": 0.5})
    with folder.log_file.open("a") as file:
        file.write('{"loss": 1}\n{"step": 2, "lo')
    folder.cut_log(2)
    lines = ['{"step": 1, "loss": 0.5}', '{"step": 2, "loss": 0.5}', '{"step": 2, "loss": 0.5}']
    assert folder.log_file.read_text().splitlines() == lines
    folder.append_log({"step": 3})
    assert folder.log_file.read_text().splitlines() == [*lines, '{"step": 3}']


def test_a_lock_is_held_and_given_back(folder):
    lock = folder.path / ".lock"
    with folder.locked():
        assert int(lock.read_text()) == os.getpid()
    assert not lock.exists()


def test_a_lock_is_given_back_after_an_error(folder):
    def fail() -> None:
        with folder.locked():
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    with folder.locked():
        pass


def test_a_living_process_keeps_its_lock(folder):
    (folder.path / ".lock").write_text(str(os.getppid()))
    with pytest.raises(RunError, match=rf"run is in use by another run \(process {os.getppid()}\): wait for it, or"):
        folder.locked().__enter__()
    assert (folder.path / ".lock").read_text() == str(os.getppid())


def test_a_dead_process_loses_its_lock(folder):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    (folder.path / ".lock").write_text(str(dead.pid))
    with folder.locked():
        assert int((folder.path / ".lock").read_text()) == os.getpid()


@pytest.mark.parametrize("content", ["", "somebody", "9" * 30])
def test_a_lock_that_names_no_process_is_taken_over(content, folder):
    (folder.path / ".lock").write_text(content)
    with folder.locked():
        assert int((folder.path / ".lock").read_text()) == os.getpid()
