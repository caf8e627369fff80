"""``marks.json`` in a run's folder: written whole or not at all, read strictly, undone by steps."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mrgs.errors import ConfigError, RunError, warn_user
from mrgs.marks.mark import Mark, Marks
from mrgs.runs.open import TrainedRun
from mrgs.scene import Scene
from mrgs.system.atomic import changing, require_folder, write_error, write_text
from mrgs.system.disk import read_text
from mrgs.system.typed_json import Finite, from_json

FILE, UNDO_FILE = "marks.json", "marks.undo.json"
VERSION = 2
"""2 has proposals and severities; files of version 1 are read too."""

STEPS_KEPT = 50
SAME = 1e-3
"""Share of the extent by which the cameras of one scene may seem to differ."""

Change = Callable[[Marks], Marks]


@dataclass(frozen=True)
class CameraSpread:
    """Positions of a scene's cameras in brief, to recognise its coordinate frame: their number,
    their mean and the largest distance from it, scene units."""

    images: int
    centre: tuple[Finite, Finite, Finite]
    extent: Finite

    @classmethod
    def of(cls, positions: Float[np.ndarray, "n 3"]) -> CameraSpread:
        """The spread of positions in world coordinates."""
        centre = positions.mean(axis=0)
        extent = np.linalg.norm(positions - centre, axis=1).max()
        x, y, z = centre.tolist()
        return cls(len(positions), (x, y, z), float(extent))

    @classmethod
    def of_scene(cls, scene: Scene) -> CameraSpread:
        """The spread of the cameras of a scene's training images."""
        cameras = [camera for view in scene.train for camera in view.cameras.values()]
        return cls.of(np.stack([camera.position.numpy() for camera in cameras]))

    @classmethod
    def of_run(cls, run: TrainedRun) -> CameraSpread:
        """The spread of a run's training cameras."""
        poses = [np.array(image.pose).reshape(3, 4) for image in run.facts.images]
        return cls.of(np.stack([-pose[:, :3].T @ pose[:, 3] for pose in poses]))

    def is_world_of(self, other: CameraSpread) -> bool:
        """Whether places in one world are the same places in the other."""
        tolerance = SAME * max(self.extent, other.extent, 1e-9)
        return (
            self.images == other.images
            and abs(self.extent - other.extent) <= tolerance
            and np.allclose(self.centre, other.centre, rtol=0, atol=tolerance)
        )


class MarkStore:
    """The marks of one run on disk; every change is saved at once."""

    def __init__(self, folder: Path, spread: CameraSpread) -> None:
        self.folder = folder
        self.file, self._undo_file = folder / FILE, folder / UNDO_FILE
        self._spread = spread

    @property
    def stamp(self) -> tuple[int, ...] | None:
        """Changes whenever the file does; None without one."""
        return file_stamp(self.file)

    def read(self) -> Marks:
        """The marks; none where there is no file. RunError if the run's folder is gone, or the file
        cannot be read, is of a newer version of the program, or its marks are those of another
        model. MrgsWarning if the file is damaged: it is renamed, and there are no marks."""
        require_folder(self.folder)
        states = self._states(self.file)
        return states[0] if states else Marks()

    def edit(self, change: Change) -> Marks:
        """Change the marks as they are on the disk now, and save them; returns them. ConfigError if
        the change is not possible, RunError as for ``read``, or if the file cannot be written."""
        with changing(self.file):
            before = self.read()
            after = change(before)
            if after != before:
                self._write([*self._states(self._undo_file), before][-STEPS_KEPT:], self._undo_file)
                self._write([after], self.file)
        return after

    def undo(self) -> Marks:
        """Undo the last change, and save; returns the marks. Errors as for ``edit``; also
        ConfigError if there is nothing to undo."""
        with changing(self.file):
            now, states = self.read(), self._states(self._undo_file)
            while states and states[-1] == now:  # a change that was cut off before its second file
                states.pop()
            if not states:
                raise ConfigError("there is nothing to undo: the marks have not been changed")
            before = states.pop()
            self._write([before], self.file)
            self._write(states, self._undo_file)
        return before

    def _write(self, states: Sequence[Marks], path: Path) -> None:
        """Write the only state into ``marks.json``, or any number into the file for undoing."""
        lists = ("marks", "proposals", "dropped")
        contents: list[dict[str, Any]] = [
            {
                "reference": state.reference,
                **{name: [mark.to_json() for mark in getattr(state, name)] for name in lists},
            }
            for state in states
        ]
        content = contents[0] if path == self.file else {"states": contents}
        head = {"program": f"mrgs {version('mrgs')}", "version": VERSION}
        whole = {**head, "cameras": asdict(self._spread), **content}
        write_text(path, json.dumps(whole, indent=1, ensure_ascii=False, allow_nan=False) + "\n")

    def _states(self, path: Path) -> list[Marks]:
        """The states of the marks in a file, the oldest first: only one in ``marks.json``; none
        without a file, or where it is damaged, which sets it aside. RunError if it cannot be read,
        or is not for this program or this model."""
        try:
            if not path.exists():
                return []
            document = json.loads(read_text(path))
            self._require_own(path, from_json(_Head, document))
            states = []
            for each in from_json(list[dict[str, Any]], document.get("states", [document])):
                state = from_json(_State, each)
                lists = (state.marks, state.proposals, state.dropped)
                marks, proposals, dropped = (tuple(map(Mark.from_json, own)) for own in lists)
                states.append(Marks(marks, state.reference, proposals, dropped))
            return states
        except OSError as error:
            if error.errno != errno.EFBIG:
                raise RunError(
                    f"{path} cannot be read ({error.strerror}): check its permissions"
                ) from error
            self._set_aside(path, "it is too large")
        except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
            self._set_aside(path, f"it is not JSON, {error}")
        except (ConfigError, ValueError) as error:
            self._set_aside(path, str(error))
        return []

    def _require_own(self, path: Path, head: _Head) -> None:
        """Check that a file is for this program and this model; RunError if not."""
        if head.version > VERSION:
            raise RunError(f"{path} was written by a newer version of mrgs: update mrgs")
        if not head.cameras.is_world_of(self._spread):
            raise RunError(
                f"{path} holds the marks of another model, whose places mean nothing here: move "
                f"the file away, or put it back into its own run"
            )

    def _set_aside(self, path: Path, reason: str) -> None:
        """Keep a damaged file under another name, with a warning."""
        names = (f"{path.name}.damaged{number}" for number in ["", *range(2, 1000)])
        aside = next(path.with_name(each) for each in names if not path.with_name(each).exists())
        try:
            path.rename(aside)
        except OSError as error:
            raise write_error(path, error) from error
        reason = " ".join(reason.split())
        warn_user(
            f"{path} is damaged ({reason}): it is kept as {aside.name}; fix it and rename it, or "
            f"undo to bring back the marks before the last change"
        )


def file_stamp(path: Path) -> tuple[int, ...] | None:
    """Changes whenever a file does, also if replaced within a clock tick; None without one."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_ctime_ns, status.st_size


def judged_content(folder: Path) -> str:
    """A user's marks and judgements in a run as a text, without the proposals, which the report
    writes itself; of a damaged file its whole text."""
    path = folder / FILE
    text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else "{}"
    try:
        content = json.loads(text)
        return json.dumps([content.get(name) or None for name in ("reference", "marks", "dropped")])
    except (ValueError, RecursionError, AttributeError):
        return text


@dataclass(frozen=True)
class _Head:
    """What every file begins with."""

    version: int
    cameras: CameraSpread


@dataclass(frozen=True)
class _State:
    """The marks in ``marks.json``, or in a state of the file for undoing."""

    marks: list[dict[str, Any]]
    reference: str = ""
    proposals: list[dict[str, Any]] = field(default_factory=list)
    dropped: list[dict[str, Any]] = field(default_factory=list)
