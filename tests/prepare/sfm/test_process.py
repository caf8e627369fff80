from __future__ import annotations

import importlib.metadata
import os
from pathlib import Path

import pytest

from mrgs.errors import ConfigError, RunError, SceneError
from mrgs.prepare.sfm import process
from mrgs.prepare.sfm.process import run_colmap


def silent(step: str, done: int, of: int) -> None:
    pass


@pytest.fixture
def child(monkeypatch):
    """Puts a script in the place of the process; ``folder`` is known in it."""
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "4.0.4")
    return lambda script: monkeypatch.setattr(
        process,
        "CHILD",
        ("-c", "import json, os, sys, time; folder = json.loads(sys.argv[1])\n" + script),
    )


def test_progress_is_forwarded(child, tmp_path):
    child("""
print("a library that prints")
print(json.dumps({"step": "features", "done": 1, "of": 2}))
print(json.dumps({"end": "done"}))
""")
    steps = []
    run_colmap(tmp_path, lambda *step: steps.append(step))
    assert steps == [("features", 1, 2)]


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ("print(json.dumps({'end': 'error', 'message': 'the disk is full'})); "
         "sys.exit(1)", "the disk is full"),
        ("os.kill(os.getpid(), "
         "9)", "the system ended the process (signal 9), most likely for want of memory; close "
         "other programs or use smaller photos, and call again to continue"),
        ("os.abort()", "the process ended with status -6 (no message); call again to continue"),
        ("pass", "the process ended with status 0 (no message); call again to continue"),
    ],
)  # fmt: skip
def test_a_child_that_fails(child, tmp_path, script, reason):
    child(script)
    with pytest.raises(SceneError) as error:
        run_colmap(tmp_path, silent)
    assert str(error.value) == f"finding the poses failed: {reason}; see {tmp_path / 'log.txt'}"


def test_what_the_child_writes_to_its_errors_is_kept(child, tmp_path):
    child("sys.stderr.write('why'); sys.exit(3)")
    with pytest.raises(SceneError):
        run_colmap(tmp_path, silent)
    assert (tmp_path / "log.txt").read_text() == "why"


def test_the_child_ends_with_the_call(child, tmp_path):
    child("""
open(folder + "/pid", "w").write(str(os.getpid()))
print(json.dumps({"step": "features", "done": 0, "of": 2}), flush=True)
time.sleep(600)
""")

    def interrupt(step: str, done: int, of: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_colmap(tmp_path, interrupt)
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


def test_a_poisoned_current_folder_is_not_imported_from(monkeypatch, tmp_path):
    """The real child, which fails for want of a job: all that it imports before comes from
    elsewhere."""
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "4.0.4")
    monkeypatch.chdir(tmp_path)
    for name in ("json", "mrgs", "numpy", "pycolmap"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('from the photos')")
    (tmp_path / "sfm").mkdir()
    with pytest.raises(SceneError, match=r"job\.json") as error:
        run_colmap(Path("sfm"), silent)
    assert "from the photos" not in str(error.value) + (tmp_path / "sfm" / "log.txt").read_text()


def test_a_folder_that_cannot_be_written(child, tmp_path):
    (tmp_path / "log.txt").mkdir()
    with pytest.raises(RunError) as error:
        run_colmap(tmp_path, silent)
    assert str(error.value) == (
        f"{tmp_path / 'log.txt'} cannot be written (Is a directory); free the place or choose "
        f"another"
    )


def test_without_pycolmap(monkeypatch, tmp_path):
    def missing(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", missing)
    with pytest.raises(ConfigError) as error:
        run_colmap(tmp_path, silent)
    assert str(error.value) == (
        'finding the poses needs pycolmap: pip install "mrgs[sfm]", or give poses that you have'
    )


def test_with_an_old_pycolmap(monkeypatch, tmp_path):
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "3.13.0")
    with pytest.raises(ConfigError) as error:
        run_colmap(tmp_path, silent)
    assert str(error.value) == 'pycolmap 3.13.0 is too old: pip install "mrgs[sfm]"'
