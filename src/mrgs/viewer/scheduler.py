"""When to draw: coarse while something moves, sharp once it rests."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError

REST_S = 0.2
"""Time without a change after which the sharp picture is drawn."""

_log = logging.getLogger(__name__)


class RenderScheduler:
    """One worker thread that always draws the newest state.

    Requests that come while a picture is being drawn are merged into one. A sharp picture that was
    overtaken by a change is not drawn.

    Args:
        draw: draws and shows a picture; called with True for a coarse one. What it raises is passed
            to ``on_error``.
        on_error: called with every exception of ``draw``.
        rest_s: time without a change before the sharp picture.
    """

    def __init__(
        self,
        draw: Callable[[bool], None],
        on_error: Callable[[Exception], None],
        rest_s: float = REST_S,
    ) -> None:
        self._draw = draw
        self._on_error = on_error
        self._rest_s = rest_s
        self._changed = threading.Condition()
        self._coarse_due = False
        self._sharp_due = False
        self._drawing = False
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="mrgs-viewer", daemon=True)
        self._thread.start()

    def moved(self) -> None:
        """The camera moves: a coarse picture now, a sharp one when it rests."""
        self._request(coarse=True)

    def refresh(self) -> None:
        """Something else has changed: a sharp picture now."""
        self._request(coarse=False)

    @property
    def busy(self) -> bool:
        """Whether a picture is due, or being drawn."""
        with self._changed:
            return self._drawing or self._coarse_due or self._sharp_due

    def close(self) -> None:
        """End the thread after the picture that it is drawing; does not wait for it."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def _request(self, coarse: bool) -> None:
        with self._changed:
            self._coarse_due |= coarse
            self._sharp_due = True
            self._changed.notify()

    def _work(self) -> None:
        coarse = False
        while True:
            with self._changed:
                if coarse and not self._coarse_due:
                    self._changed.wait(self._rest_s)
                self._drawing = False
                self._changed.wait_for(lambda: self._closed or self._coarse_due or self._sharp_due)
                if self._closed:
                    return
                self._drawing = True
                coarse = self._coarse_due
                self._coarse_due = False
                if not coarse:
                    self._sharp_due = False
            self._draw_contained(coarse)

    def _draw_contained(self, coarse: bool) -> None:
        try:
            self._draw(coarse)
        except CancelledError:
            self.close()
        except Exception as error:
            try:
                self._on_error(error)
            except Exception:
                _log.debug("the browser could not be notified", exc_info=True)
