from __future__ import annotations

import errno
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from mrgs.errors import MrgsWarning, RunError
from mrgs.method.config import TrainConfig, from_yaml, make_config
from mrgs.run_files.checkpoint import load_facts
from mrgs.run_files.folder import RunFolder
from mrgs.runs.train import TemporaryRunFolder


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
    assert folder.read_config(from_yaml) == config
    assert folder.checkpoints() == []


def test_a_run_is_not_started_twice(folder):
    touch_checkpoints(folder, 10)
    with pytest.raises(RunError, match="already"):
        folder.start(TrainConfig())


def test_a_run_that_died_before_its_first_checkpoint_is_started_anew(folder):
    folder.append_log({"step": 1})
    folder.start(TrainConfig(seed=5))
    assert folder.read_config(from_yaml).seed == 5
    assert not folder.log_file.exists()


@pytest.mark.parametrize("name", ["config.yaml", "log.jsonl"])
def test_a_folder_of_something_else_is_left_alone(name, tmp_path):
    (tmp_path / name).write_text("mine")
    with pytest.raises(RunError, match=f"{name} that is not"):
        RunFolder(tmp_path).start(TrainConfig())
    assert (tmp_path / name).read_text() == "mine"


def test_a_folder_with_other_files_becomes_no_run(tmp_path):
    (tmp_path / "thesis.odt").write_text("mine")
    with pytest.raises(RunError, match=r"thesis\.odt") as error:
        RunFolder(tmp_path).start(TrainConfig())
    assert error.value.options == ("output",)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.odt"]


def test_what_an_earlier_run_left_hinders_no_new_one(tmp_path):
    (tmp_path / ".DS_Store").touch()
    (tmp_path / "survey.yaml").write_text("client: somebody")
    (tmp_path / "checkpoints").mkdir()
    folder = RunFolder(tmp_path)
    folder.start(TrainConfig())
    (tmp_path / "notes.txt").write_text("mine")
    folder.start(TrainConfig(seed=3))  # died before its first checkpoint
    assert folder.read_config(from_yaml).seed == 3


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(RunError, match=r"file/run cannot be written"):
        RunFolder(tmp_path / "file" / "run").locked().__enter__()


def test_checkpoints_are_sorted_by_step_and_the_newest_two_are_kept(folder):
    touch_checkpoints(folder, 2_000_000, 1_000, 999_999)
    assert folder.newest_checkpoint() == folder.checkpoint_file(2_000_000)
    folder.drop_old_checkpoints()
    assert folder.checkpoints() == [
        folder.checkpoint_file(999_999),
        folder.checkpoint_file(2_000_000),
    ]
    folder.drop_old_checkpoints()
    assert len(folder.checkpoints()) == 2


def test_a_checkpoint_that_newer_ones_replace_before_it_is_read_is_not_missed(folder):
    """As beside a training in another process that saves twice in the meantime."""
    touch_checkpoints(folder, 10, 20)

    def load(path: Path) -> str:
        if path == folder.checkpoint_file(20):
            touch_checkpoints(folder, 30, 40)
            folder.drop_old_checkpoints()
            raise RunError("it is gone")
        return path.name

    assert folder.load_newest(load) == "step_000040.safetensors"


def test_a_checkpoint_that_stays_and_cannot_be_read_is_refused(folder):
    touch_checkpoints(folder, 10)
    folder.checkpoint_file(20).symlink_to(folder.path / "nowhere")
    with pytest.raises(RunError, match=r"step_000020.*cannot be read"):
        folder.load_newest(load_facts)


def test_other_files_are_no_checkpoints(folder):
    touch_checkpoints(folder, 5)
    (folder.path / "checkpoints" / ".step_000009.12.safetensors").touch()
    (folder.path / "checkpoints" / "step_000009.txt").touch()
    assert folder.checkpoints() == [folder.checkpoint_file(5)]


def test_what_is_not_a_run_is_named(tmp_path, folder):
    empty = RunFolder(tmp_path)
    with pytest.raises(RunError, match=r"no config\.yaml"):
        empty.newest_checkpoint()
    with pytest.raises(RunError, match=r"no config\.yaml"):
        empty.read_config(from_yaml)
    with pytest.raises(RunError, match="no checkpoint"):
        folder.newest_checkpoint()


def test_a_folder_of_runs_says_where_they_are(tmp_path, folder):
    outer = RunFolder(tmp_path)
    with pytest.raises(RunError, match=r"no config\.yaml"):
        outer.newest_checkpoint()  # nothing is trained in it yet
    touch_checkpoints(folder, 10)
    inside = re.escape(str(folder.path))
    with pytest.raises(RunError, match=f"contains {inside}"):
        outer.newest_checkpoint()
    other = RunFolder(tmp_path / "best")
    other.start(TrainConfig())
    touch_checkpoints(other, 10)
    with pytest.raises(RunError, match=f"/best.* {inside}"):
        outer.read_config(from_yaml)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (b"\xff\xfe", "read"),
        (b"max_steps: 0", "max_steps .*1, not 0.*retrain"),
        (b"steps: 7", "'steps'.*retrain"),
    ],
)
def test_a_damaged_configuration_is_named(content, named, folder):
    folder.config_file.write_bytes(content)
    with pytest.raises(RunError, match=rf"config\.yaml.* {named}"):
        folder.read_config(from_yaml)


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


@pytest.mark.parametrize(
    "line", ["[1]", "null", '{"step": null}', '{"step": 1e999}', "[" * 100_000, "\x00"]
)
def test_what_is_no_entry_of_the_log_counts_as_behind_everything(line, folder):
    folder.log_file.write_text(f'{{"step": 1}}\n{line}\n{{"step": 2}}\n', encoding="utf-8")
    folder.cut_log(7)
    kept = folder.log_file.read_text(encoding="utf-8").splitlines()
    assert [json.loads(each) for each in kept] == [{"step": 1}, {"step": 2}]


def test_numbers_of_the_log_that_are_not_finite_are_null(folder):
    folder.append_log({"step": 1, "loss": float("nan"), "rgb": float("-inf"), "thermal": 0.5})
    written = json.loads(folder.log_file.read_text(), parse_constant=pytest.fail)
    assert written == {"step": 1, "loss": None, "rgb": None, "thermal": 0.5}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="a system without pipes")
def test_a_log_that_is_no_file_is_refused(tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.path.mkdir()
    os.mkfifo(folder.log_file)
    with (
        pytest.raises(RunError, match=r"log\.jsonl is not a file"),
        folder.training(TrainConfig(), resume=True),
    ):
        pass


def test_settings_that_were_cut_off_are_named_by_their_place(folder):
    touch_checkpoints(folder, 10)
    lines = folder.config_file.read_text(encoding="utf-8").splitlines(keepends=True)
    (place,) = (i for i, line in enumerate(lines) if line.startswith("  dssim:"))
    folder.config_file.write_text("".join(lines[:place] + lines[place + 1 :]), encoding="utf-8")
    with pytest.warns(MrgsWarning, match=r"lacks loss\.dssim"):
        folder.read_whole_config(from_yaml)


def test_a_lock_is_held_and_given_back(folder):
    with (
        folder.locked(),
        pytest.raises(RunError, match="in use"),
    ):
        RunFolder(folder.path).locked().__enter__()
    with RunFolder(folder.path).locked():
        pass


def test_a_lock_is_given_back_after_an_error(folder):
    with pytest.raises(KeyError), folder.locked():
        raise KeyError
    with folder.locked():
        pass


def test_a_dead_process_loses_its_lock(folder):
    program = (
        "import os; from mrgs.run_files.folder import RunFolder;"
        f"RunFolder({str(folder.path)!r}).locked().__enter__(); os._exit(1)"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 1
    with folder.locked():
        pass


def test_a_discarded_run_leaves_what_is_not_its_own(folder):
    folder.discard()
    assert not folder.path.exists()
    folder.start(make_config("mrgs"))
    (folder.path / "notes.txt").write_text("mine")
    folder.discard()
    assert [path.name for path in folder.path.iterdir()] == ["notes.txt"]


def test_ctrl_c_reaches_the_caller_where_the_lock_cannot_be_removed(folder, monkeypatch):
    """As on some network drives while it is open."""
    unlink = Path.unlink

    def refuse(path: Path, missing_ok: bool = False) -> None:
        if path.name == ".lock":
            raise PermissionError(errno.EACCES, "in use by another process", str(path))
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(KeyboardInterrupt), folder.training(make_config("mrgs"), resume=False):
        raise KeyboardInterrupt
    assert not folder.config_file.exists()


def test_a_folder_stays_where_it_is_when_the_current_one_changes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = RunFolder("run")
    monkeypatch.chdir("/")
    assert folder.path == tmp_path / "run"


def test_a_temporary_folder_goes_with_its_object_but_not_in_a_fork(monkeypatch):
    ours, inherited = TemporaryRunFolder(), TemporaryRunFolder()
    places = ours.path, inherited.path
    del ours
    with monkeypatch.context() as patch:
        patch.setattr("os.getpid", lambda: -1)
        del inherited
    assert [place.exists() for place in places] == [False, True]
    places[1].rmdir()
