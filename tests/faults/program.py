"""The program in a process of its own, as users start it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import torch
from safetensors.torch import load_file

from mrgs.method.config import from_yaml
from mrgs.run_files.folder import RunFolder
from mrgs.training import train
from tests.helpers.scenes import write_scene

SOURCE = Path(__file__).parents[2] / "src"
PATIENCE_S = 900.0
"""A machine with other work may take minutes to compile the kernels."""

SMALL = ("--preset", "fast", "--max-gaussians", 100)


@dataclass(frozen=True)
class Ended:
    """A process that has ended: its exit status (negative for a signal) and what it printed."""

    status: int
    out: str
    err: str

    @property
    def is_clean(self) -> bool:
        """Neither a traceback nor a signal ended it."""
        return self.status >= 0 and "Traceback" not in self.out + self.err

    @property
    def is_refusal(self) -> bool:
        """It ended with one line that names the error."""
        lines = [line for line in self.err.splitlines() if line.startswith("mrgs: error: ")]
        return self.is_clean and self.status == 2 and len(lines) == 1

    def __str__(self) -> str:
        last = [*self.err.strip().splitlines(), *self.out.strip().splitlines(), ""][0]
        return f"exit {self.status}, {last[:150]!r}"


def environment(**changes: str) -> dict[str, str]:
    """This process's environment with one thread and without a GPU, changed."""
    path = os.pathsep.join([str(SOURCE), os.environ.get("PYTHONPATH", "")])
    own = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    return {**os.environ, **own, "PYTHONPATH": path.rstrip(os.pathsep), **changes}


def limited_files(size_bytes: int) -> str:
    """Script of the shell that starts its arguments with files that cannot grow beyond a size. They
    keep no bytecode: Python would take a cut file of it for whole, in all later processes."""
    return f'ulimit -f {size_bytes // 512}; export PYTHONDONTWRITEBYTECODE=1; exec "$@"'


class Started(subprocess.Popen[str]):
    """A process started by a script of the shell. What it prints goes into files: a pipe that
    nobody reads stops a long training after 64 KiB.

    Args:
        command: to start.
        shell: script that starts its arguments, such as one that closes a stream first.
        variables: of the environment, to change.
        options: of ``Popen``.
    """

    def __init__(
        self,
        command: Sequence[object],
        shell: str = 'exec "$@"',
        variables: Mapping[str, str] | None = None,
        **options: Any,
    ) -> None:
        self._printed = [
            TemporaryFile("w+", errors="replace")  # noqa: SIM115
            for _ in range(2)
        ]
        super().__init__(
            ["sh", "-c", shell, "sh", sys.executable, *map(str, command)],
            stdin=subprocess.DEVNULL, stdout=self._printed[0], stderr=self._printed[1],
            env=environment(**(variables or {})), preexec_fn=_as_in_a_terminal, **options,
        )  # fmt: skip

    def take_printed(self) -> list[str]:
        """What was printed on both outputs; to be called once, after the end."""
        texts = []
        for file in self._printed:
            with file:
                file.seek(0)
                texts.append(file.read())
        return texts


def start(*arguments: object, **options: Any) -> Started:
    """Start the program with arguments of its own; the options are those of ``Started``."""
    return Started(["-m", "mrgs", *arguments], **options)


def ended(process: Started, timeout_s: float = PATIENCE_S) -> Ended:
    """Wait for the end of a process; one that takes too long is killed."""
    try:
        process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    return Ended(process.returncode, *process.take_printed())


def run(*arguments: object, **options: Any) -> Ended:
    """Start the program, and wait for its end."""
    return ended(start(*arguments, **options))


def wait_until(test: Callable[[], bool], process: Started, seconds: float = PATIENCE_S) -> bool:
    """Wait for something that a process brings about; False if it has ended, or never does."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if test():
            return True
        if process.poll() is not None:
            return False
        time.sleep(0.02)
    return False


def logged_step(run_folder: Path) -> int:
    """The last step in a run's log; 0 without one."""
    try:
        lines = (run_folder / "log.jsonl").read_text().splitlines()
        return max(json.loads(line)["step"] for line in lines)
    except (OSError, ValueError):
        return 0


def newest_step(run_folder: Path) -> int:
    """The step of a run's newest checkpoint; 0 without one."""
    names = [path.stem for path in (run_folder / "checkpoints").glob("step_*.safetensors")]
    return max((int(name.removeprefix("step_")) for name in names), default=0)


def stopped_after_saving(process: Started, run_folder: Path) -> Ended:
    """Ask a training to stop once it has written a further checkpoint."""
    before = newest_step(run_folder)
    wait_until(lambda: newest_step(run_folder) > before, process)
    process.send_signal(signal.SIGTERM)
    return ended(process)


def is_run_left_alone(run_folder: Path, scene: Path, whole: Path) -> bool:
    """Whether a run's newest checkpoint has the bits of a training that nothing interrupts.

    Args:
        run_folder: of a method of Gaussians.
        scene: that it was trained on.
        whole: folder for the training without interruptions.
    """
    found = RunFolder(run_folder)
    config, step = found.read_config(from_yaml), newest_step(run_folder)
    expected = train(scene, whole, config, stop_at=step).newest_checkpoint()
    ends = [load_file(path) for path in (expected, found.newest_checkpoint())]
    return ends[0].keys() == ends[1].keys() and all(
        torch.equal(tensor, ends[1][name]) for name, tensor in ends[0].items()
    )


def small_scene(folder: Path) -> Path:
    """A scene that a step takes milliseconds for; made once."""
    return folder if folder.exists() else write_scene(folder)


def photos_of(scene: Path, folder: Path) -> tuple[object, ...]:
    """Arguments of ``mrgs prepare`` for the photos of a scene, but for the folder to make."""
    for name, source in (("rgb", "images"), ("thermal", "thermal")):
        (folder / name).mkdir(parents=True, exist_ok=True)
        for photo in (scene / source).glob("*.png"):
            (folder / name / photo.name).write_bytes(photo.read_bytes())
    return folder, "--poses", scene, "--one-camera", "--bounds", 10, 30


def _as_in_a_terminal() -> None:
    """A background shell leaves Ctrl-C ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
