from __future__ import annotations

import os
from pathlib import Path

import pytest

from mrgs.errors import ConfigError, RunError, SceneError
from mrgs.prepare.sfm.reconstruct import require_pycolmap, run_colmap


def silent(step: str, done: int, of: int) -> None:
    pass


def run(script: str, folder: Path, progress=silent) -> None:
    """Run a script instead of the process; ``folder`` is known in it."""
    before = "import json, os, sys, time; folder = json.loads(sys.argv[1])\n"
    run_colmap(folder, progress, ("-c", before + script))


def test_progress_is_forwarded(tmp_path):
    script = """
print("a library that prints")
print(json.dumps({"step": "features", "done": 1, "of": 2}))
print(json.dumps({"end": "done"}))
"""
    steps = []
    run(script, tmp_path, lambda *step: steps.append(step))
    assert steps == [("features", 1, 2)]


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ("print(json.dumps({'end': 'error', 'message': 'full'})); sys.exit(1)", "full"),
        ("os.kill(os.getpid(), 9)", "smaller photos"),
        ("os.abort()", "status -6"),
        ("pass", "status 0"),
    ],
)
def test_a_child_that_fails(tmp_path, script, reason):
    with pytest.raises(SceneError) as error:
        run(script, tmp_path)
    assert reason in str(error.value)
    assert str(tmp_path / "log.txt") in str(error.value)


def test_what_the_child_writes_to_its_errors_is_kept(tmp_path):
    with pytest.raises(SceneError):
        run("sys.stderr.write('why'); sys.exit(3)", tmp_path)
    assert (tmp_path / "log.txt").read_text() == "why"


def test_the_child_ends_with_the_call(tmp_path):
    script = """
open(folder + "/pid", "w").write(str(os.getpid()))
print(json.dumps({"step": "features", "done": 0, "of": 2}), flush=True)
time.sleep(600)
"""

    def interrupt(step: str, done: int, of: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(script, tmp_path, interrupt)
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


def test_a_poisoned_current_folder_is_not_imported_from(monkeypatch, tmp_path):
    """The real child, which fails for want of a job: all that it imports before comes from
    elsewhere."""
    monkeypatch.chdir(tmp_path)
    for name in ("json", "mrgs", "numpy", "pycolmap"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('from the photos')")
    (tmp_path / "sfm").mkdir()
    with pytest.raises(SceneError, match=r"job\.json") as error:
        run_colmap(Path("sfm"), silent)
    assert "from the photos" not in str(error.value) + (tmp_path / "sfm" / "log.txt").read_text()


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "log.txt").mkdir()
    with pytest.raises(RunError) as error:
        run_colmap(tmp_path, silent)
    assert f"{tmp_path / 'log.txt'} cannot" in str(error.value)


def test_without_pycolmap(monkeypatch):
    monkeypatch.setattr("mrgs.prepare.sfm.reconstruct.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="needs pycolmap") as error:
        require_pycolmap()
    assert 'pip install "mrgs[sfm]"' in str(error.value)
