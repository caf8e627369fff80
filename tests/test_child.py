from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mrgs.system.child import CHILD_FOLDER, OUT_OF_MEMORY, Child, child_environment

SCRIPT = "from mrgs.system.child import read_request, send, when_asked_to_stop\n"


@pytest.fixture
def start(tmp_path: Path):
    """Starts children that run a script, and ends them after the test."""
    children = []

    def start(script: str, request: object = None) -> Child:
        children.append(Child(("-c", SCRIPT + script), request, tmp_path / "log.txt"))
        return children[-1]

    yield start
    for child in children:
        child.close()


def test_the_request_comes_back_and_what_is_no_message_is_skipped(start):
    child = start("print('a library'); send(got=read_request()); send(end='done')", {"a": [1, "é"]})
    assert list(child.messages()) == [{"got": {"a": [1, "é"]}}]
    assert child.end == {"end": "done"}
    assert child.failure() is None


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ("send(end='error', message='no disk'); raise SystemExit(2)", "no disk"),
        ("raise ValueError('broken')", "status 1 (ValueError: broken)"),
        ("send(step=1)", "status 0 (no message)"),
        ("import os; os.kill(os.getpid(), 9)", OUT_OF_MEMORY),
    ],
)
def test_a_failure_has_a_reason(start, script, reason):
    child = start(script)
    list(child.messages())
    assert reason in (child.failure() or "")


@pytest.mark.parametrize("line", ["5", "[1]", "null", '"end"'])
def test_only_objects_are_messages(start, line):
    child = start(f"print({line!r}); send(end='done')")
    assert list(child.messages()) == []
    assert child.failure() is None


def test_a_child_runs_apart_from_the_users_folder_and_keyboard(start):
    child = start(
        "import os; send(folder=os.getcwd(), group=os.getsid(0) != os.getsid(os.getppid()), "
        "wait=os.environ['OMP_WAIT_POLICY']); send(end='done')"
    )
    (told,) = child.messages()
    assert told == {"folder": str(CHILD_FOLDER.resolve()), "group": True, "wait": "PASSIVE"}


def test_a_child_whose_parent_hears_nothing_any_more_goes_on(start, tmp_path):
    done = tmp_path / "done"
    child = start(
        "import sys; from pathlib import Path; sys.stdin.read(); send(step=1); "
        f"send(step=2); Path({str(done)!r}).write_text('')"
    )
    child._process.stdout.close()
    child.stop()
    assert child._process.wait(60) == 0
    assert done.exists()
    assert child.log.read_text() == ""


def test_a_child_can_be_asked_to_stop(start):
    child = start(
        "import threading; stop = threading.Event(); when_asked_to_stop(stop.set); send(step=1); "
        "stop.wait(); send(end='stopped')"
    )
    messages = child.messages()
    assert next(messages) == {"step": 1}
    child.stop()
    assert list(messages) == []
    assert child.failure() is None


def test_what_a_child_loads_does_not_wait_for_its_parent(start):
    """On Windows, loading a library asks for the type of standard input, which waits for a thread
    that reads from it."""
    child = start(
        "import os; when_asked_to_stop(lambda: send(end='stopped')); "
        "send(reads_nothing=os.path.samestat(os.stat(os.devnull), os.fstat(0)))"
    )
    assert list(child.messages()) == [{"reads_nothing": True}]


def test_a_child_ends_with_its_parent(tmp_path):
    orphan = (
        "import os, time; when_asked_to_stop(lambda: os._exit(1)); send(pid=os.getpid()); "
        "time.sleep(600)"
    )
    parent = f"""
from pathlib import Path
from mrgs.system.child import Child
child = Child(("-c", {SCRIPT + orphan!r}), None, Path({str(tmp_path / "log.txt")!r}))
print(next(child.messages())["pid"], flush=True)
import os; os.kill(os.getpid(), 9)
"""
    run = subprocess.run(
        [sys.executable, "-c", parent], capture_output=True, text=True, check=False
    )
    assert run.returncode == -signal.SIGKILL
    pid = int(run.stdout)
    deadline = time.monotonic() + 20
    with pytest.raises(ProcessLookupError):  # noqa: PT012
        while time.monotonic() < deadline:
            os.kill(pid, 0)
            time.sleep(0.05)


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
