from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from mrgs.system.isolation import CHILD_FOLDER, child_environment


def test_the_python_path_means_the_same_folders(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", "own", str(tmp_path / "other")]))
    expected = os.pathsep.join([str(tmp_path / "own"), str(tmp_path / "other")])
    assert child_environment()["PYTHONPATH"] == expected


def test_a_python_path_of_nothing_is_none(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep)
    assert "PYTHONPATH" not in child_environment()


def test_changes_are_made(monkeypatch):
    monkeypatch.setenv("KEPT", "1")
    environment = child_environment(ADDED="2")
    assert (environment["KEPT"], environment["ADDED"]) == ("1", "2")


def test_a_module_on_a_relative_path_is_found_and_one_in_the_current_folder_is_not(
    monkeypatch, tmp_path: Path
):
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "wanted.py").write_text("import json, mrgs")
    (tmp_path / "json.py").write_text("raise RuntimeError")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", "own")
    for safe in ("1", ""):  # Python 3.10 does not know it: the folder alone must do
        environment = child_environment(PYTHONSAFEPATH=safe)
        subprocess.run(
            [sys.executable, "-m", "wanted"], env=environment, cwd=CHILD_FOLDER, check=True
        )
