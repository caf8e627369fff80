"""One browser: what it may send, and what is done and sent back for it."""

from __future__ import annotations

import itertools
import logging
import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError, Future
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

import msgspec
import numpy as np
import torch
from msgspec import UNSET, UnsetType

from mrgs.errors import ConfigError, MrgsError
from mrgs.marks.mark import MarkKind, Marks
from mrgs.pictures.palette import PaletteName
from mrgs.runs.open import Run
from mrgs.scene import Box, Camera
from mrgs.scene.rotations import rigid_transform
from mrgs.viewer import facts
from mrgs.viewer.board import MarkBoard
from mrgs.viewer.inspection import Inspection
from mrgs.viewer.panes import fitted_size
from mrgs.viewer.saving import VideoProgress, render_video, save_keyframes, save_screenshot
from mrgs.viewer.settings import Settings, Subject
from mrgs.viewer.source import Effort, Worker

MOVING_S = 0.05
"""Processor time of a picture while the camera moves; the picture has as many pixels as fit."""

FEWEST_PIXELS = 240
"""Longest side of the coarsest picture."""

LARGEST_MESSAGE = 65_536
"""Bytes."""

CHANGE = "change of marks"
"""Name of jobs that change marks: none replaces another, and they outlive their browser."""

MOST_CHANGES, CHANGES_S = 20, 2.0
"""Largest number of changes of marks that one browser may make within a number of seconds."""

_log = logging.getLogger(__name__)

Send = Callable[[str | bytes], "Future[None]"]


class Browser:
    """One connected browser; its state is ``inspection``. A picture is drawn only when the browser
    asks for one, which a hidden page does not, and none while another is being sent. ``send`` sends
    a text or bytes, from any thread."""

    def __init__(
        self, subject: Subject, start: Mapping[str, Any], note: str, worker: Worker, send: Send
    ) -> None:
        self.inspection = Inspection(subject)
        self.subject = subject
        self._worker = worker
        self._send_data = send
        self.look: Look | None = None
        self._drawn: Look | None = None
        self._sending = False
        self._changes = itertools.count()
        self._changed_s: deque[float] = deque(maxlen=MOST_CHANGES)
        self._moving_side_px = float(subject.source.most_pixels["moving"])
        self.send("hello", **facts.hello_facts(self.inspection, start), note=note)
        if subject.board is not None:
            subject.board.subscribe(self._send_marks)
            self.enqueue("marks", self._measure_marks)

    def receive(self, data: str | bytes) -> None:
        """Do what a message asks for, at once or as a job of the worker; what is not understood is
        answered, and has no effect."""
        try:
            message = decode(data)
            # A mark that a change is about has its refusal beside it in the list.
            number = "keep" if isinstance(message, Keep) else getattr(message, "mark", None)
            if message.job == CHANGE:
                now_s, changed_s = time.monotonic(), self._changed_s
                if len(changed_s) == MOST_CHANGES and now_s - changed_s[0] < CHANGES_S:
                    text = "too many changes of marks at once: wait a second, then go on"
                    self.send("refused", mark=number, text=text)
                    return
                changed_s.append(now_s)
            if message.job:
                self.enqueue(message.job, lambda: message._act(self), number)
            else:
                message._act(self)
        except (ValueError, RecursionError, MrgsError) as error:
            self.report(str(error) or repr(error), failed=True)
        finally:
            self.subject.source.charge()

    def close(self) -> None:
        """Drop the browser's waiting jobs, but not its changes of marks."""
        self._worker.drop(
            lambda key: isinstance(key, tuple) and key[0] == id(self) and key[1] != CHANGE
        )
        if self.subject.board is not None:
            self.subject.board.unsubscribe(self._send_marks)

    def enqueue(self, name: str, job: Callable[[], None], mark: int | str | None = None) -> None:
        """Let the worker run a job in place of a waiting one of this name, but for changes of
        marks. Errors are sent to the page: of a change with the number of its mark, or "keep"."""

        def contained() -> None:
            try:
                job()
            except CancelledError:  # the training has ended, which the worker handles
                raise
            except Exception as error:
                text = str(error) or repr(error)
                if name == CHANGE:
                    self.send("refused", mark=mark, text=text)
                else:
                    self.report(text, failed=True)
                if not isinstance(error, MrgsError | ValueError):
                    raise

        number = next(self._changes) if name == CHANGE else 0
        self._worker.put((id(self), name, number), contained)

    def send(self, kind: str, **more: Any) -> None:
        """Send facts, under the name that the page knows them by."""
        self._send_data(facts.encode({"type": kind, **more}))

    def report(self, text: str, failed: bool = False) -> None:
        """Show a text below the picture, perhaps as an error."""
        self.send("status", text=text, failed=failed)

    def draw(self) -> None:
        """Draw the newest ``look`` and send the picture, unless that has been done. While another
        picture is being sent, this one waits for it."""
        look = self.look
        if look is None or look is self._drawn or self._sending:
            return
        self._drawn = look
        source, moving = self.subject.source, look.effort == "moving"
        side = self._moving_side_px if moving else source.most_pixels[look.effort]
        camera = look.camera()
        camera = camera.resized(*fitted_size(camera.width, camera.height, round(side)))
        started_s = time.thread_time()
        try:
            with source.small_work() if moving else nullcontext():
                drawn = self.inspection.picture(camera, moving=moving)
        except Exception:
            self.send("undrawn", number=look.number)
            raise
        longest = max(look.width, look.height)
        message = facts.picture_message(self.inspection, drawn, look.number, look.effort, longest)
        if moving:
            # More or fewer pixels for the next picture, as this one took less or more time.
            factor = math.sqrt(MOVING_S / max(time.thread_time() - started_s, 1e-3))
            side = self._moving_side_px * min(max(factor, 0.7), 1.15)
            self._moving_side_px = min(max(side, FEWEST_PIXELS), source.most_pixels["moving"])
        source.charge()
        self._sending = True

        def sent(_: Future[None]) -> None:
            self._sending = False
            self.enqueue("picture", self.draw)

        self._send_data(message).add_done_callback(sent)

    @property
    def board(self) -> MarkBoard:
        """The marks of the run. ConfigError if there are none without the scene."""
        if self.subject.board is None:
            raise ConfigError("marks need the scene: open the run with it")
        return self.subject.board

    def _measure_marks(self) -> None:
        """Measure what the files contain, for a browser that has just connected."""
        try:
            self.board.refresh()
        finally:
            self._send_marks()

    def _send_marks(self) -> None:
        if self.board.is_measuring:
            self.send("measuring")
            return
        self.send("marks", **facts.marks_facts(self.board, self.subject))
        if (run := self.board.shown) is not None:
            self.send("kept", box=run.crop, left_out=run.left_out, shown=run.gaussian_count)
        self.send("changed")  # the page then asks for a picture: it knows where its camera is

    def send_keyframes(self) -> None:
        """Send how many keyframes the path has, and what it still needs."""
        count = len(self.inspection.keyframes)
        few = {0: "No keyframes yet.", 1: "1 keyframe; add at least one more."}
        self.send("keyframes", text=few.get(count, f"{count} keyframes."))

    def report_saved(self, path: Path) -> None:
        """Name a file that has been written."""
        place = path.relative_to(self.subject.folder).as_posix()
        self.report(f"Saved in the run's folder: {place}")

    def render_next(self, video: Iterator[VideoProgress]) -> None:
        """Render the next frame; other jobs have their turn before the one after it."""
        progress = next(video, None)
        if progress is None:
            return
        if progress.path is not None:
            self.report_saved(progress.path)
        else:
            self.report(f"Rendering frame {progress.done} of {progress.total}…")
        self.enqueue("video", lambda: self.render_next(video))


FARTHEST = 1e9
"""Scene units, also pixels: numbers beyond have no meaning in a picture."""

Number: TypeAlias = Annotated[float, msgspec.Meta(ge=-FARTHEST, le=FARTHEST)]
Positive: TypeAlias = Annotated[float, msgspec.Meta(gt=1e-3, le=FARTHEST)]
Share: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1)]
Side: TypeAlias = Annotated[int, msgspec.Meta(ge=1, le=facts.LONGEST_SIDE_PX)]
Index: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=10**9)]
Seconds: TypeAlias = Annotated[
    float, msgspec.Meta(ge=facts.VIDEO_SECONDS[0], le=facts.VIDEO_SECONDS[1])
]
Limits: TypeAlias = tuple[Number, Number]
Corners: TypeAlias = Annotated[
    tuple[tuple[Share, Share], ...], msgspec.Meta(min_length=1, max_length=200)
]
Text: TypeAlias = Annotated[str, msgspec.Meta(max_length=10_000)]
"""Longer than any field of a mark may be: ``Mark`` itself refuses with a sentence."""


class BrowserMessage(msgspec.Struct, forbid_unknown_fields=True):
    """Anything that a browser sends; ``type`` names its class. It acts at once or, if it uses the
    model, as the worker's ``job`` of that name, in place of a waiting one (but see ``CHANGE``)."""

    job: ClassVar[str] = ""

    def _act(self, browser: Browser) -> None:
        """Do what the message asks for. MrgsError or ValueError if that is not possible."""
        raise NotImplementedError


class Look(BrowserMessage, tag="look"):
    """Draw a picture from a camera whose axes in the world (right, down, forward) are the rows of
    ``rotation``, for a window of the screen's pixels; ``number`` is returned with it."""

    number: Index
    rotation: Annotated[tuple[Number, ...], msgspec.Meta(min_length=9, max_length=9)]
    position: tuple[Number, Number, Number]
    focal: tuple[Positive, Positive]
    centre: tuple[Number, Number]
    width: Side
    height: Side
    effort: Effort

    def camera(self) -> Camera:
        """The camera to draw from; ValueError if the rotation is not one."""
        rotation = np.array(self.rotation).reshape(3, 3)
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
            raise ValueError("the camera's axes must be of unit length and perpendicular")
        (fx, fy), (cx, cy) = self.focal, self.centre
        K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
        viewmat = rigid_transform(rotation, -rotation @ np.array(self.position))
        return Camera(K, viewmat, self.width, self.height)

    def _act(self, browser: Browser) -> None:
        self.camera()  # raises for a wrong one
        browser.look = self
        browser.enqueue("picture", browser.draw)


class Choose(BrowserMessage, tag="choose"):
    """The choices of the panel, see ``Settings``; ``limits`` and ``isotherm`` are those of the
    modality named ``scaled``."""

    mode: Index
    palette: PaletteName
    scaled: str | None
    limits: Limits | None
    isotherm: Limits | None
    share: Share
    marks: bool

    def _act(self, browser: Browser) -> None:
        subject, old = browser.subject, browser.inspection.settings
        if self.mode >= len(subject.modes):
            raise ConfigError(f"there is no picture number {self.mode}")
        scaled = next((each for each in subject.modalities if each.name == self.scaled), None)
        limits = dict(old.limits)
        if scaled is not None:
            limits.pop(scaled, None)
            if self.limits is not None:
                limits[scaled] = self.limits
                if not self.limits[0] < self.limits[1]:
                    raise ConfigError("the upper end of the scale must be above the lower")
        browser.inspection.settings = Settings(
            subject.modes[self.mode], self.palette, limits, self.isotherm, self.share,
            scaled or old.scaled, self.marks,
        )  # fmt: skip
        browser.send("changed")


class Hover(BrowserMessage, tag="hover"):
    """Send the value under the cursor; x and y from 0 to 1 over the picture."""

    x: Share
    y: Share

    def _act(self, browser: Browser) -> None:
        browser.send("hover", text=browser.inspection.hover(self.x, self.y))


class ReadPoint(BrowserMessage, tag="read"):
    """Read the point under a place of the picture, and send it; x and y from 0 to 1."""

    job = "read"
    x: Share
    y: Share

    def _act(self, browser: Browser) -> None:
        point = browser.inspection.click(self.x, self.y)
        if point is None:
            browser.report("Nothing there: the model is empty at this point.")
        text = None if point is None else facts.point_text(point, browser.subject)
        browser.send("point", of=text)
        browser.send("changed")


class AddMark(BrowserMessage, tag="add_mark"):
    """Add a mark through places of the picture, x and y from 0 to 1; a box has two corners."""

    job = CHANGE
    kind: MarkKind
    points: Corners

    def _act(self, browser: Browser) -> None:
        browser.inspection.add_mark(self.kind, self.points)
        browser.send("point", of=None)  # what was read is no longer drawn


class ChangeMark(BrowserMessage, tag="change_mark"):
    """Give the mark of a number (see ``MarkNumbers``) other fields; those left out stay."""

    job = CHANGE
    mark: Index
    name: Text | UnsetType = UNSET
    note: Text | UnsetType = UNSET
    severity: Text | UnsetType = UNSET
    emissivity: Number | UnsetType | None = UNSET
    reflected_c: Number | UnsetType | None = UNSET

    @property
    def fields(self) -> dict[str, Any]:
        """The fields that change, by name."""
        names = [name for name in self.__struct_fields__ if name != "mark"]
        return {name: found for name in names if (found := getattr(self, name)) is not UNSET}

    def _act(self, browser: Browser) -> None:
        browser.board.change(self.mark, self.fields)


class DeleteMark(BrowserMessage, tag="delete_mark"):
    """Delete the mark of a number."""

    job = CHANGE
    mark: Index

    def _act(self, browser: Browser) -> None:
        browser.board.delete(self.mark)


class Judge(BrowserMessage, tag="judge"):
    """Make the report's proposal of a name a mark, or drop it."""

    job = CHANGE
    mark: Text
    accept: bool

    def _act(self, browser: Browser) -> None:
        judged = Marks.accepting if self.accept else Marks.dropping
        browser.board.edit(lambda marks: judged(marks, self.mark))


class ReferTo(BrowserMessage, tag="refer_to"):
    """Let all differences refer to the mark of a number; None for none."""

    job = CHANGE
    mark: Index | None

    def _act(self, browser: Browser) -> None:
        browser.board.refer_to(self.mark)


class Undo(BrowserMessage, tag="undo"):
    """Undo the last change of the marks."""

    job = CHANGE

    def _act(self, browser: Browser) -> None:
        browser.board.undo()


class Keep(BrowserMessage, tag="keep"):
    """Keep a part of the model: around what is drawn at places of the picture, as ``AddMark``;
    between other ``sides``, as of ``Box.between``; all of it; or what was kept before."""

    job = CHANGE
    kind: Literal["box", "polygon", "sides", "all", "undo"]
    points: Corners = ()
    sides: tuple[Number, Number, Number, Number, Number, Number] = (0.0,) * 6

    def _act(self, browser: Browser) -> None:
        board, box = browser.board, None
        crop = None if board.shown is None else board.shown.crop
        if self.kind == "undo":
            return board.keep(Run.undo_keep)
        if self.kind == "sides":
            box = Box.between(*self.sides, () if crop is None else crop.outlines)
        elif self.kind != "all":
            box = browser.inspection.box_of(self.kind, self.points)
            box = box if crop is None else box.within(crop)
        board.keep(lambda run: run.keep(box))


class GoToPhoto(BrowserMessage, tag="photo"):
    """Choose the captured view that the modes with photos show, by its index."""

    index: Index

    def _act(self, browser: Browser) -> None:
        if self.index >= len(browser.subject.views):
            raise ConfigError(f"there is no photo number {self.index}")
        browser.inspection.view_index = self.index


class FitScales(BrowserMessage, tag="fit"):
    """Lock the scales at the limits of what the picture shows."""

    job = "fit"

    def _act(self, browser: Browser) -> None:
        browser.inspection.fit()
        limits = browser.inspection.settings.limits
        browser.send("limits", of={modality.name: ends for modality, ends in limits.items()})
        browser.send("changed")


class TakeScreenshot(BrowserMessage, tag="screenshot"):
    """Write the picture into a file."""

    job = "screenshot"

    def _act(self, browser: Browser) -> None:
        browser.report_saved(save_screenshot(browser.inspection))


class AddKeyframe(BrowserMessage, tag="add_keyframe"):
    """Add the picture's camera to the path."""

    def _act(self, browser: Browser) -> None:
        browser.inspection.add_keyframe()
        browser.send_keyframes()


class ClearPath(BrowserMessage, tag="clear_path"):
    """Remove all keyframes."""

    def _act(self, browser: Browser) -> None:
        browser.inspection.keyframes = ()
        browser.send_keyframes()


class SavePath(BrowserMessage, tag="save_path"):
    """Write the keyframes into a file."""

    job = "save"
    seconds: Seconds

    def _act(self, browser: Browser) -> None:
        browser.report_saved(save_keyframes(browser.inspection, self.seconds))


class RenderVideo(BrowserMessage, tag="video"):
    """Render the path through the keyframes."""

    job = "video"
    seconds: Seconds

    def _act(self, browser: Browser) -> None:
        browser.render_next(render_video(browser.inspection, self.seconds))


AnyMessage: TypeAlias = (
    Look | Choose | Hover | ReadPoint | GoToPhoto | FitScales
    | AddMark | ChangeMark | DeleteMark | Judge | ReferTo | Undo | Keep
    | TakeScreenshot | AddKeyframe | ClearPath | SavePath | RenderVideo
)  # fmt: skip

_decoder = msgspec.json.Decoder(AnyMessage)


def decode(data: str | bytes) -> AnyMessage:
    """A message from a browser; ValueError if it is not JSON, unknown, or out of its range."""
    try:
        return _decoder.decode(data)
    except ValueError as error:
        raise ValueError(
            f"the viewer does not understand what the page sent: reload the page ({error})"
        ) from error
