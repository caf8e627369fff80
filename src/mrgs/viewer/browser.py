"""One browser: does what it asks for, and sends it pictures and texts."""

from __future__ import annotations

import itertools
import logging
import math
import threading
import time
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from mrgs.errors import ConfigError, MrgsError
from mrgs.marks.mark import Marks
from mrgs.viewer import texts
from mrgs.viewer.board import MarkBoard
from mrgs.viewer.cameras import fitted_size
from mrgs.viewer.facts import hello_facts, marks_facts, picture_message
from mrgs.viewer.inspection import Inspection
from mrgs.viewer.messages import (
    Act,
    AddMark,
    AnyMessage,
    ChangeMark,
    Choose,
    DeleteMark,
    GoToPhoto,
    Hover,
    Judge,
    Look,
    ReadPoint,
    ReferTo,
    RenderVideo,
    SavePath,
    decode,
    encode,
)
from mrgs.viewer.saving import VideoProgress, render_video, save_keyframes, save_screenshot
from mrgs.viewer.settings import Settings, Start, Subject
from mrgs.viewer.source import Worker

MOVING_S = 0.05
"""Processor time of a picture while the camera moves; the picture has as many pixels as fit."""

FEWEST_PIXELS = 240
"""Longest side of the coarsest picture."""

CHANGE = "change of marks"
"""First part of the names of jobs that change marks."""

_log = logging.getLogger(__name__)

Send = Callable[[str | bytes], "Future[None]"]


class Browser:
    """One connected browser; its state is ``inspection``.

    A picture is drawn only when the browser asks for one, and a browser whose page is hidden does
    not ask. While one picture is on its way no other is drawn for it.

    Args:
        subject: the model to show.
        start: the first viewpoint, and what the camera turns about.
        note: a sentence for the user; may be empty.
        worker: does everything that uses the model.
        send: sends a text or bytes, from any thread.
    """

    def __init__(
        self, subject: Subject, start: Start, note: str, worker: Worker, send: Send
    ) -> None:
        self.inspection = Inspection(subject)
        self._subject = subject
        self._worker = worker
        self._send = send
        self._lock = threading.Lock()
        self._look: Look | None = None
        self._sending = False
        self._changes = itertools.count()
        self._moving_side_px = float(subject.source.most_pixels["moving"])
        self._tell("hello", **hello_facts(self.inspection, start), note=note)
        if subject.board is not None:
            subject.board.listen(self._marks_changed)
            self._do("marks", self._show_marks)

    def receive(self, data: str | bytes) -> None:
        """Do what a message asks for; what cannot be understood is answered, and has no effect."""
        try:
            self._obey(decode(data))
        except (ValueError, RecursionError, MrgsError) as error:
            self._report(error)
        self._subject.source.charge()

    def set_note(self, note: str) -> None:
        """Replace the note, and say that the model has changed."""
        self._tell("note", text=note)

    def close(self) -> None:
        """Forget what the browser still waits for, but not its changes of marks."""
        self._worker.drop(self._is_for_this_browser_alone)
        if self._subject.board is not None:
            self._subject.board.leave(self._marks_changed)

    def _is_for_this_browser_alone(self, key: Hashable) -> bool:
        match key:
            case (owner, (kind, _)) if kind == CHANGE:
                return False
            case (owner, _):
                return bool(owner == id(self))
        return False

    def _obey(self, message: AnyMessage) -> None:
        match message:
            case Look():
                message.camera()  # raises for a wrong one
                with self._lock:
                    self._look = message
                self._draw_if_idle()
            case Hover():
                self._tell("hover", text=self.inspection.hover(message.x, message.y))
            case Choose():
                self._choose(message)
            case ChangeMark() | DeleteMark() | ReferTo():
                self._edit(lambda: self._edit_mark(message), message.mark)
            case AddMark() | Judge():
                self._edit(lambda: self._add_mark(message))
            case ReadPoint():
                self._do("read", lambda: self._read(message.x, message.y))
            case GoToPhoto():
                self.inspection.view_index = self._view_index(message.index)
            case SavePath():
                self._do(
                    "save", lambda: self._saved(save_keyframes(self.inspection, message.seconds))
                )
            case RenderVideo():
                self._do("video", lambda: self._begin_video(message.seconds))
            case Act():
                self._act(message)

    def _act(self, message: Act) -> None:
        match message.what:
            case "fit":
                self._do("fit", self._fit)
            case "undo":
                self._edit(lambda: self._board.undo())
            case "screenshot":
                self._do("screenshot", lambda: self._saved(save_screenshot(self.inspection)))
            case "add_keyframe":
                self.inspection.add_keyframe()
                self._path_changed()
            case "clear_path":
                self.inspection.keyframes = ()
                self._path_changed()

    @property
    def _board(self) -> MarkBoard:
        if self._subject.board is None:
            raise ConfigError("marks need the scene: open the run with it")
        return self._subject.board

    def _edit(self, change: Callable[[], None], number: int | None = None) -> None:
        """Have marks changed by the worker; what is refused is said where they are listed, at the
        mark of a number if there is one. No change replaces another that waits."""
        self._do(
            (CHANGE, next(self._changes)), change, lambda error: self._refuse_change(error, number)
        )

    def _edit_mark(self, message: ChangeMark | DeleteMark | ReferTo) -> None:
        """Change a mark, save it, and measure; then every browser is told."""
        match message:
            case ChangeMark():
                self._board.change(message.mark, message.fields)
            case DeleteMark():
                self._board.delete(message.mark)
            case ReferTo():
                self._board.refer_to(message.mark)

    def _add_mark(self, message: AddMark | Judge) -> None:
        """Add a mark, or judge a proposed one; the same follows."""
        match message:
            case AddMark():
                self.inspection.add_mark(message.kind, message.points)
                self._tell_point()
            case Judge():
                judge = Marks.accepting if message.accept else Marks.dropping
                self._board.edit(lambda marks: judge(marks, message.mark))

    def _do(
        self,
        name: Hashable,
        job: Callable[[], None],
        report: Callable[[Exception], None] | None = None,
    ) -> None:
        """Have a job done by the worker; what it raises is told to the user."""
        report = report or self._report

        def contained() -> None:
            try:
                job()
            except (MrgsError, ValueError) as error:
                report(error)
            except Exception as error:
                report(error)
                raise

        self._worker.put((id(self), name), contained)

    def _fit(self) -> None:
        self.inspection.fit()
        limits = self.inspection.settings.limits
        self._tell("limits", of={modality.name: ends for modality, ends in limits.items()})
        self._redraw()

    # --- pictures ---

    def _draw_if_idle(self) -> None:
        with self._lock:
            if self._look is None or self._sending:
                return
        self._do("picture", self._draw)

    def _draw(self) -> None:
        with self._lock:
            look, self._look = self._look, None
        if look is None:
            return
        source, moving = self._subject.source, look.effort == "moving"
        longest = self._moving_side_px if moving else source.most_pixels[look.effort]
        camera = look.camera()
        camera = camera.resized(*fitted_size(camera.width, camera.height, round(longest)))
        started_s = time.thread_time()
        if moving:
            with source.small_work():
                drawn = self.inspection.picture(camera, moving=True)
        else:
            drawn = self.inspection.picture(camera)
        message = picture_message(self.inspection, drawn, look)
        if moving:
            self._adapt(time.thread_time() - started_s)
        source.charge()
        self._sending = True
        self._send(message).add_done_callback(self._sent)

    def _adapt(self, taken_s: float) -> None:
        """More or fewer pixels for the next picture on the way, as this one took less or more."""
        factor = math.sqrt(MOVING_S / max(taken_s, 1e-3))
        side = self._moving_side_px * min(max(factor, 0.7), 1.15)
        most = self._subject.source.most_pixels["moving"]
        self._moving_side_px = min(max(side, FEWEST_PIXELS), most)

    def _sent(self, _: Future[None]) -> None:
        self._sending = False
        self._draw_if_idle()

    def _redraw(self) -> None:
        """Have the browser ask for a picture: it knows where its camera is."""
        self._tell("changed")

    # --- choices and actions ---

    def _choose(self, message: Choose) -> None:
        subject, old = self._subject, self.inspection.settings
        if message.mode >= len(subject.modes):
            raise ConfigError(f"there is no picture number {message.mode}")
        scaled = next((each for each in subject.modalities if each.name == message.scaled), None)
        limits = dict(old.limits)
        if scaled is not None:
            limits.pop(scaled, None)
            if message.limits is not None:
                limits[scaled] = _rising(message.limits)
        self.inspection.settings = Settings(
            subject.modes[message.mode], message.palette, limits, message.isotherm, message.share,
            scaled or old.scaled, message.marks,
        )  # fmt: skip
        self._redraw()

    def _read(self, x: float, y: float) -> None:
        reading = self.inspection.click(x, y)
        if reading is None:
            self._say(texts.EMPTY_HINT)
        self._tell_point()
        self._redraw()

    def _tell_point(self) -> None:
        point = self.inspection.point
        self._tell("point", of=None if point is None else texts.point(point, self._subject))

    def _show_marks(self) -> None:
        """Measure what the files hold, for a browser that has just come."""
        try:
            self._board.refresh()
        finally:
            self._marks_changed()

    def _marks_changed(self) -> None:
        self._tell("marks", **marks_facts(self._board, self._subject))
        self._redraw()

    def _path_changed(self) -> None:
        self._tell("keyframes", text=texts.keyframes(len(self.inspection.keyframes)))

    def _begin_video(self, seconds: float) -> None:
        self._go_on(render_video(self.inspection, seconds))

    def _go_on(self, video: Iterator[VideoProgress]) -> None:
        """Render the next frame; then the other jobs have their turn before the one after it."""
        progress = next(video, None)
        if progress is None:
            return
        if progress.path is not None:
            self._saved(progress.path)
        else:
            self._say(f"Rendering frame {progress.done} of {progress.total}…")
        self._do("video", lambda: self._go_on(video))

    def _view_index(self, index: int) -> int:
        if index >= len(self._subject.views):
            raise ConfigError(f"there is no photo number {index}")
        return index

    # --- what it is told ---

    def _saved(self, path: Path) -> None:
        place = path.relative_to(self._subject.folder).as_posix()
        self._say(f"Saved in the run's folder: {place}")

    def _refuse_change(self, error: Exception, number: int | None) -> None:
        self._tell("refused", mark=number, text=str(error) or repr(error))

    def _report(self, error: Exception) -> None:
        self._say(str(error) or repr(error), failed=True)

    def _say(self, text: str, failed: bool = False) -> None:
        self._tell("status", text=text, failed=failed)

    def _tell(self, kind: str, **facts: Any) -> None:
        self._send(encode({"type": kind, **facts}))


def _rising(limits: tuple[float, float]) -> tuple[float, float]:
    low, high = limits
    if not low < high:
        raise ConfigError("the upper end of the scale must be above the lower")
    return low, high
