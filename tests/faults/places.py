"""Disks that are full, and names that are unusual."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tests.faults.program import (
    SMALL,
    Ended,
    limited_files,
    newest_step,
    photos_of,
    run,
    small_scene,
)
from tests.faults.tally import Tally

STEPS = 20

NAMES = (
    "a b", "it's", 'say "so"', "-dash", "ünï", "новый", "<img src=x onerror=alert(1)>",
    "[a](b)|c", "x" * 250, "\udcff\udcfe", "new\nline", "$(touch x)",
)  # fmt: skip


def file_size(folder: Path, limits: Sequence[int], command: str = "train") -> Tally:
    """Files that may not grow beyond a limit, in bytes, as on a full disk or beyond a quota."""
    tally, scene = Tally(), small_scene(folder / "scene")
    for limit in limits:
        output = folder / f"limited_{limit}"
        options = ("--output", output, *SMALL, "--max-steps", STEPS) if command == "train" else ()
        found = run(command, scene, *options, shell=limited_files(limit))
        left = list(folder.rglob(".mrgs-*"))
        # A checkpoint of few Gaussians may be small enough.
        is_whole = found.status == 0 and newest_step(output) == STEPS
        holds = (found.is_refusal or is_whole) and not left
        tally.judge(f"{command}, files of {limit} bytes", holds, f"{found}; left: {left}")
    return tally


def full_disks(folder: Path, trained: Path, rooms: Sequence[int]) -> Tally:
    """Commands on a disk with little room; needs the right to mount. They go on once there is."""
    tally, scene = Tally(), small_scene(folder / "scene")
    options = photos_of(scene, folder / "photos")
    for room in rooms:
        with _disk(folder / "disk", room) as disk:
            shutil.copytree(trained, disk / "run")
            _fill(disk, room)
            for command in ("eval", "render", "export", "report"):
                found = run(command, disk / "run")
                tally.judge(
                    f"{command}, {room} bytes", found.status == 0 or found.is_refusal, found
                )
            arguments = ("prepare", options[0], disk / "scene", *options[1:])
            found = run(*arguments)
            tally.judge(f"prepare, {room} bytes", found.status == 0 or found.is_refusal, found)
            (disk / "filler").unlink()
            tally.judge(f"prepare, room after {room} bytes", run(*arguments).status == 0)
    return tally


def names(folder: Path, chosen: Sequence[str] = NAMES, commands: Sequence[str] = ()) -> Tally:
    """Scenes of any name, printed where only ASCII can be: used, or refused with one line."""
    tally, scene = Tally(), small_scene(folder / "scene")
    variables = {"LC_ALL": "C", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    for name in chosen:
        place = folder / "named" / name
        if not place.exists():
            shutil.copytree(scene, place)
        output = folder / "runs" / f"{name[:200]} run"
        train = ("train", f"./{name}", "--output", output, *SMALL, "--max-steps", 3)
        tasks = [("check", f"./{name}"), *([train] if commands else [])]
        tasks += [(command, output) for command in commands]
        for task in tasks:
            found = run(*task, variables=variables, cwd=folder / "named")
            tally.judge(f"{task[0]} of {name[:40]!r}", _is_good(found), found)
    return tally


def _is_good(found: Ended) -> bool:
    return found.is_clean and (found.status in (0, 1) or found.is_refusal)


@contextmanager
def _disk(folder: Path, room: int) -> Iterator[Path]:
    folder.mkdir(exist_ok=True)
    options = ("-t", "tmpfs", "-o", f"size={room + 40_000_000}", "tmpfs")
    subprocess.run(["mount", *options, str(folder)], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def _fill(disk: Path, room: int) -> None:
    """Leave ``room`` bytes."""
    with open(disk / "filler", "wb") as file:
        free = os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize
        os.posix_fallocate(file.fileno(), 0, max(free - room, resource.getpagesize()))
