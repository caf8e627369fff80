"""Access to the model: at once for a trained run, between two steps while it trains. Every use goes
through a source, one after the other: Numba's portable threads allow no two kernels at once."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import CancelledError, Future
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any, Literal, NamedTuple, TypeAlias, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.render import Model, rows_in_view
from mrgs.scene import Camera
from mrgs.scene.level_of_detail import merged
from mrgs.system.gpu import HOST
from mrgs.system.threads import one_thread

_log = logging.getLogger(__name__)

Job = Callable[[], object]


class Worker:
    """One thread that does the jobs of all browsers in turn, one of each before a second of any. A
    newer job replaces a waiting one with the same key, a tuple that begins with the browser: of a
    moving camera, only the newest position is drawn."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._jobs: dict[Hashable, dict[Hashable, Job]] = {}  # of the browsers, by their turn
        self._working = False
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="mrgs-viewer", daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Whether a job is due, or being done."""
        with self._changed:
            return self._working or bool(self._jobs)

    def put(self, key: Hashable, job: Job) -> None:
        """Do a job after the browser's waiting ones, in place of one with the same key."""
        with self._changed:
            if not self._closed:
                owner = key[0] if isinstance(key, tuple) else key
                self._jobs.setdefault(owner, {})[key] = job
                self._changed.notify()

    def drop(self, keys: Callable[[Hashable], bool]) -> None:
        """Forget the waiting jobs whose keys fit."""
        with self._changed:
            left = {
                owner: {key: job for key, job in jobs.items() if not keys(key)}
                for owner, jobs in self._jobs.items()
            }
            self._jobs = {owner: jobs for owner, jobs in left.items() if jobs}

    def close(self) -> None:
        """Forget all jobs, and end the thread after the one that it is doing; does not wait."""
        with self._changed:
            self._closed = True
            self._jobs.clear()
            self._changed.notify()

    def join(self, timeout_s: float) -> None:
        """Wait until the thread has ended, at most for some seconds."""
        self._thread.join(timeout_s)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._working = False
                self._changed.wait_for(lambda: self._closed or self._jobs)
                if self._closed:
                    return
                owner, jobs = next(iter(self._jobs.items()))
                job = jobs.pop(next(iter(jobs)))
                del self._jobs[owner]
                if jobs:  # it is the browser's turn again after all others
                    self._jobs[owner] = jobs
                self._working = True
            try:
                job()
            except CancelledError:  # the training has ended
                self.close()
            except Exception:
                _log.warning("the viewer failed", exc_info=True)


MOST_IN_VIEW = 80_000
"""Gaussians that are drawn ten times a second by two cores."""

LEVEL_FACTOR = 5
"""Ratio of the numbers of Gaussians of neighbouring levels."""


class DetailLevel(NamedTuple):
    """A model of fewer Gaussians, of which each of the coarsest level ``stands_for`` a number."""

    model: Model
    stands_for: Float[Tensor, " m"]


class LevelsOfDetail:
    """A model in several levels of detail, which are made in a thread; until then there is only the
    model itself, which must not change and be in the host's memory. At most ``most_in_view``
    Gaussians may be in view.
    """

    def __init__(self, model: Model, most_in_view: int = MOST_IN_VIEW) -> None:
        self._model = model
        self._most = most_in_view
        self._levels: Sequence[DetailLevel] = ()
        self.maker = threading.Thread(target=self._make, name="mrgs-detail", daemon=True)
        if len(model.gaussians) > most_in_view:
            self.maker.start()

    def model_for(self, camera: Camera) -> Model:
        """The finest level that shows few enough Gaussians to this camera; else the coarsest."""
        if not self._levels:
            return self._model
        coarsest = self._levels[-1].model
        rows = rows_in_view(coarsest, camera)
        for level in self._levels:
            in_view = level.stands_for if rows is None else level.stands_for[rows]
            if in_view.sum() <= self._most:
                return level.model
        return coarsest

    @torch.no_grad()
    def _make(self) -> None:
        """The levels, from the finest to the coarsest."""
        models, members = [self._model], []
        while len(models[-1].gaussians) > self._most:
            model = models[-1]
            finer = len(model.gaussians)
            coarse = merged(model.gaussians, max(finer // LEVEL_FACTOR, min(self._most, finer - 1)))
            residuals = model.temperature_residuals
            models.append(
                replace(
                    model,
                    gaussians=coarse.gaussians,
                    neighbours=None,
                    temperature_residuals=None if residuals is None else coarse.averaged(residuals),
                )
            )
            members.append(coarse.of)
        coarsest = len(models[-1].gaussians)
        of = torch.arange(coarsest)  # which of the coarsest each Gaussian of a level stands in
        levels = [DetailLevel(models[-1], torch.ones(coarsest))]
        for model, coarser in zip(models[-2::-1], members[::-1], strict=True):
            of = of[coarser]
            levels.append(DetailLevel(model, of.bincount(minlength=coarsest).float()))
        self._levels = levels[::-1]


Result = TypeVar("Result")

Effort = Literal["moving", "resting", "still"]
"""A picture soon, a sharp one, or one of the screen's full resolution."""

LIVE_SHARE = 0.04
"""Share of the training's time that looking at it may take; the promise is 5 %."""

MAX_CREDIT_S = 0.5
"""Time saved up while nobody looks; more would make the first pictures a hiccup."""


class TrainedSource:
    """Access to a model that no longer changes by itself."""

    most_pixels: Mapping[Effort, int] = {"moving": 640, "resting": 1280, "still": 4096}
    """Longest side of a picture, by how long the camera rests."""

    def __init__(self, model: Model) -> None:
        self._lock = threading.Lock()
        self.show(model)

    def show(self, model: Model) -> None:
        """Give another model in its place, from the next job on."""
        with self._lock:
            self._model, self._levels = model, LevelsOfDetail(model)

    def run(self, job: Callable[[Model], Result], moving: Camera | None = None) -> Result:
        """Run a job on the model after those before it; returns its result. ``moving`` is the
        camera of a picture that is wanted soon, drawn from as few Gaussians as that takes."""
        with self._lock:
            return job(self._model if moving is None else self._levels.model_for(moving))

    def small_work(self) -> AbstractContextManager[None]:
        """Around the drawing of a small picture: on one thread, see ``one_thread``."""
        return one_thread()

    def charge(self) -> None:
        """Does nothing: no training competes for the processor."""


class LiveSource:
    """A model in training: jobs run on its thread between steps, within a share of its time."""

    most_pixels: Mapping[Effort, int] = {"moving": 400, "resting": 640, "still": 640}

    def __init__(
        self,
        share: float = LIVE_SHARE,
        clock: Callable[[], float] = time.perf_counter,
        thread_clock: Callable[[], float] = time.thread_time,
    ) -> None:
        self._share = share
        self._clock = clock
        self._thread_clock = thread_clock
        self._charged = threading.local()
        self._credit_s = 0.0
        self._expected_s = 0.0
        self._last = clock()
        self._jobs: deque[tuple[Future[Any], Callable[[Model], Any]]] = deque()
        self._lock = threading.Lock()
        self._closed = False

    def run(self, job: Callable[[Model], Result], moving: Camera | None = None) -> Result:
        """Wait until the training has run the job between two steps, and return its result, also
        while the camera moves. CancelledError if the source was closed."""
        future: Future[Result] = Future()
        with self._lock:
            if self._closed:
                future.cancel()
            else:
                self._jobs.append((future, job))
        return future.result()

    def small_work(self) -> AbstractContextManager[None]:
        """Changes nothing: the training's own thread draws, with as many as it trains with."""
        return nullcontext()

    def charge(self) -> None:
        """Account for the processor time that the calling thread has used since its last call, or
        since it began: painting and serving take time from the training as rendering does."""
        now = self._thread_clock()
        with self._lock:
            self._credit_s -= now - getattr(self._charged, "until_s", 0.0)
        self._charged.until_s = now

    def serve(self, model: Model) -> None:
        """Run the oldest job if the credit allows, on a copy of the model on the host; called by
        the training between two steps. Raises nothing."""
        now = self._clock()
        with self._lock:
            self._credit_s = min(self._credit_s + self._share * (now - self._last), MAX_CREDIT_S)
            self._last = now
            ready = model.neighbours is not None or model.field.config.neighbours_k == 0
            # A job that is dearer than all the credit there can be must still get its turn.
            if not self._jobs or not ready or self._credit_s < min(self._expected_s, MAX_CREDIT_S):
                return
            future, job = self._jobs.popleft()
        if future.set_running_or_notify_cancel():
            try:
                future.set_result(job(model.to(HOST)))
            except Exception as error:  # the training goes on, whatever the viewer does
                future.set_exception(error)
        spent = self._clock() - now
        with self._lock:
            self._credit_s -= spent
            # The first job may compile; its time is paid for, and soon forgotten.
            self._expected_s = spent if self._expected_s == 0 else 0.5 * (self._expected_s + spent)

    def close(self) -> None:
        """Cancel the waiting jobs, and every later one."""
        with self._lock:
            self._closed = True
            waiting = list(self._jobs)
            self._jobs.clear()
        for future, _ in waiting:
            future.cancel()


Source: TypeAlias = TrainedSource | LiveSource
