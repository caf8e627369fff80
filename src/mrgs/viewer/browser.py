"""One browser: does what its messages ask for, and sends it pictures and texts."""

from __future__ import annotations

import itertools
import logging
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any, NamedTuple

from mrgs.errors import ConfigError, MrgsError
from mrgs.marks.mark import Marks
from mrgs.viewer.board import MarkBoard
from mrgs.viewer.facts import (
    EMPTY_HINT,
    hello_facts,
    keyframes_text,
    marks_facts,
    picture_message,
    point_text,
)
from mrgs.viewer.inspection import Inspection
from mrgs.viewer.messages import (
    AddKeyframe,
    AddMark,
    ChangeMark,
    Choose,
    ClearPath,
    DeleteMark,
    FitScales,
    GoToPhoto,
    Hover,
    Judge,
    Look,
    ReadPoint,
    ReferTo,
    RenderVideo,
    SavePath,
    TakeScreenshot,
    Undo,
    decode,
    encode,
)
from mrgs.viewer.panes import fitted_size
from mrgs.viewer.saving import VideoProgress, render_video, save_keyframes, save_screenshot
from mrgs.viewer.settings import Settings, Start, Subject
from mrgs.viewer.source import Worker

MOVING_S = 0.05
"""Processor time of a picture while the camera moves; the picture has as many pixels as fit."""

FEWEST_PIXELS = 240
"""Longest side of the coarsest picture."""

CHANGE = "change of marks"
"""Name of jobs that change marks: none replaces another, and they outlive their browser."""

_log = logging.getLogger(__name__)

Send = Callable[[str | bytes], "Future[None]"]


class Browser:
    """One connected browser; its state is ``inspection``. A picture is drawn only when the browser
    asks for one, which a hidden page does not, and none while another is being sent. ``send`` sends
    a text or bytes, from any thread."""

    def __init__(
        self, subject: Subject, start: Start, note: str, worker: Worker, send: Send
    ) -> None:
        self.inspection = Inspection(subject)
        self._subject = subject
        self._worker = worker
        self._send_data = send
        self._lock = threading.Lock()
        self._look: Look | None = None
        self._sending = False
        self._changes = itertools.count()
        self._moving_side_px = float(subject.source.most_pixels["moving"])
        self._send("hello", **hello_facts(self.inspection, start), note=note)
        if subject.board is not None:
            subject.board.subscribe(self._send_marks)
            self._enqueue("marks", self._measure_marks)

    def receive(self, data: str | bytes) -> None:
        """Do what a message asks for, at once or as a job of the worker; what is not understood is
        answered, and has no effect."""
        try:
            message = decode(data)
            handler = HANDLERS[type(message)]
            if handler.job:
                # A mark that a change is about has its refusal beside it in the list.
                mark = getattr(message, "mark", None)
                number = mark if isinstance(mark, int) else None
                self._enqueue(handler.job, lambda: handler.handle(self, message), number)
            else:
                handler.handle(self, message)
        except (ValueError, RecursionError, MrgsError) as error:
            self._status(str(error) or repr(error), failed=True)
        self._subject.source.charge()

    def set_note(self, note: str) -> None:
        """Replace the note, and report that the model has changed."""
        self._send("note", text=note)

    def close(self) -> None:
        """Drop the browser's waiting jobs, but not its changes of marks."""
        self._worker.drop(
            lambda key: isinstance(key, tuple) and key[0] == id(self) and key[1] != CHANGE
        )
        if self._subject.board is not None:
            self._subject.board.unsubscribe(self._send_marks)

    def _enqueue(self, name: str, job: Callable[[], None], mark: int | None = None) -> None:
        """Let the worker run a job in place of a waiting one of this name, but for changes of
        marks. Errors are sent to the page: of a change with the number of its mark."""

        def report(error: Exception) -> None:
            text = str(error) or repr(error)
            if name == CHANGE:
                self._send("refused", mark=mark, text=text)
            else:
                self._status(text, failed=True)

        def contained() -> None:
            try:
                job()
            except (MrgsError, ValueError) as error:
                report(error)
            except Exception as error:
                report(error)
                raise

        number = next(self._changes) if name == CHANGE else 0
        self._worker.put((id(self), name, number), contained)

    def _send(self, kind: str, **facts: Any) -> None:
        self._send_data(encode({"type": kind, **facts}))

    def _status(self, text: str, failed: bool = False) -> None:
        self._send("status", text=text, failed=failed)

    def _redraw(self) -> None:
        """Make the browser ask for a picture: it knows where its camera is."""
        self._send("changed")

    # --- pictures ---

    def look(self, message: Look) -> None:
        """Draw the picture unless one is being sent; then it follows, or a newer one."""
        message.camera()  # raises for a wrong one
        with self._lock:
            self._look = message
        self._draw_if_idle()

    def _draw_if_idle(self) -> None:
        with self._lock:
            if self._look is None or self._sending:
                return
        self._enqueue("picture", self._draw)

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
            # More or fewer pixels for the next picture, as this one took less or more time.
            factor = math.sqrt(MOVING_S / max(time.thread_time() - started_s, 1e-3))
            side = self._moving_side_px * min(max(factor, 0.7), 1.15)
            self._moving_side_px = min(max(side, FEWEST_PIXELS), source.most_pixels["moving"])
        source.charge()
        self._sending = True

        def sent(_: Future[None]) -> None:
            self._sending = False
            self._draw_if_idle()

        self._send_data(message).add_done_callback(sent)

    # --- marks ---

    @property
    def board(self) -> MarkBoard:
        """The marks of the run. ConfigError if there are none without the scene."""
        if self._subject.board is None:
            raise ConfigError("marks need the scene: open the run with it")
        return self._subject.board

    def add_mark(self, message: AddMark) -> None:
        """Add a mark; the board tells all browsers."""
        self.inspection.add_mark(message.kind, message.points)
        self._send_point()

    def _measure_marks(self) -> None:
        """Measure what the files contain, for a browser that has just connected."""
        try:
            self.board.refresh()
        finally:
            self._send_marks()

    def _send_marks(self) -> None:
        self._send("marks", **marks_facts(self.board, self._subject))
        self._redraw()

    # --- choices and readings ---

    def hover(self, message: Hover) -> None:
        """Send the value under the cursor."""
        self._send("hover", text=self.inspection.hover(message.x, message.y))

    def read(self, message: ReadPoint) -> None:
        """Read a point of the model, and send it."""
        if self.inspection.click(message.x, message.y) is None:
            self._status(EMPTY_HINT)
        self._send_point()
        self._redraw()

    def _send_point(self) -> None:
        point = self.inspection.point
        self._send("point", of=None if point is None else point_text(point, self._subject))

    def choose(self, message: Choose) -> None:
        """Take over the choices of the panel."""
        subject, old = self._subject, self.inspection.settings
        if message.mode >= len(subject.modes):
            raise ConfigError(f"there is no picture number {message.mode}")
        scaled = next((each for each in subject.modalities if each.name == message.scaled), None)
        limits = dict(old.limits)
        if scaled is not None:
            limits.pop(scaled, None)
            if message.limits is not None:
                limits[scaled] = message.limits
                if not message.limits[0] < message.limits[1]:
                    raise ConfigError("the upper end of the scale must be above the lower")
        self.inspection.settings = Settings(
            subject.modes[message.mode], message.palette, limits, message.isotherm, message.share,
            scaled or old.scaled, message.marks,
        )  # fmt: skip
        self._redraw()

    def go_to_photo(self, message: GoToPhoto) -> None:
        """Choose the captured view that the modes with photos show."""
        if message.index >= len(self._subject.views):
            raise ConfigError(f"there is no photo number {message.index}")
        self.inspection.view_index = message.index

    def fit_scales(self, _: FitScales) -> None:
        """Lock the scales at the limits of what the picture shows."""
        self.inspection.fit()
        limits = self.inspection.settings.limits
        self._send("limits", of={modality.name: ends for modality, ends in limits.items()})
        self._redraw()

    # --- path and files ---

    def add_keyframe(self, _: AddKeyframe) -> None:
        """Add the picture's camera to the path."""
        self.inspection.add_keyframe()
        self._send("keyframes", text=keyframes_text(len(self.inspection.keyframes)))

    def clear_path(self, _: ClearPath) -> None:
        """Remove all keyframes."""
        self.inspection.keyframes = ()
        self._send("keyframes", text=keyframes_text(0))

    def saved(self, path: Path) -> None:
        """Name a file that has been written."""
        place = path.relative_to(self._subject.folder).as_posix()
        self._status(f"Saved in the run's folder: {place}")

    def render_next(self, video: Iterator[VideoProgress]) -> None:
        """Render the next frame; other jobs have their turn before the one after it."""
        progress = next(video, None)
        if progress is None:
            return
        if progress.path is not None:
            self.saved(progress.path)
        else:
            self._status(f"Rendering frame {progress.done} of {progress.total}…")
        self._enqueue("video", lambda: self.render_next(video))


class Handler(NamedTuple):
    """Handles messages of a class, at once, or as the worker's job of a name, which replaces a
    waiting one of that name (but see ``CHANGE``); for all that uses the model."""

    handle: Callable[[Browser, Any], None]
    job: str = ""


HANDLERS: Mapping[type, Handler] = {
    Look: Handler(Browser.look),
    Hover: Handler(Browser.hover),
    Choose: Handler(Browser.choose),
    GoToPhoto: Handler(Browser.go_to_photo),
    AddKeyframe: Handler(Browser.add_keyframe),
    ClearPath: Handler(Browser.clear_path),
    ReadPoint: Handler(Browser.read, "read"),
    FitScales: Handler(Browser.fit_scales, "fit"),
    TakeScreenshot: Handler(lambda b, m: b.saved(save_screenshot(b.inspection)), "screenshot"),
    SavePath: Handler(lambda b, m: b.saved(save_keyframes(b.inspection, m.seconds)), "save"),
    RenderVideo: Handler(
        lambda b, m: b.render_next(render_video(b.inspection, m.seconds)), "video"
    ),
    AddMark: Handler(Browser.add_mark, CHANGE),
    ChangeMark: Handler(lambda b, m: b.board.change(m.mark, m.fields), CHANGE),
    DeleteMark: Handler(lambda b, m: b.board.delete(m.mark), CHANGE),
    ReferTo: Handler(lambda b, m: b.board.refer_to(m.mark), CHANGE),
    Judge: Handler(
        lambda b, m: b.board.edit(
            lambda marks: (Marks.accepting if m.accept else Marks.dropping)(marks, m.mark)
        ),
        CHANGE,
    ),
    Undo: Handler(lambda b, m: b.board.undo(), CHANGE),
}
"""Every message that a browser may send."""
