"""The marks of the model that is shown, for all browsers that look at it."""

from __future__ import annotations

import threading
from collections.abc import Callable

from mrgs.marks.mark import Mark, MarkKind, Marks, Place
from mrgs.marks.measure import MarkMeter, MarkReading
from mrgs.marks.regions import Regions
from mrgs.marks.stereo import PhotoStereo
from mrgs.marks.store import MarkStore
from mrgs.marks.surface import SeenSurface
from mrgs.marks.uncertainty import UncertaintyMeter
from mrgs.scene import Camera

Listener = Callable[[], None]


class MarkBoard:
    """The marks on the disk, as they were measured last.

    Everything that measures must be called where the model may be used, see ``Worker``.

    Args:
        store: keeps the marks in the run's folder.
        meter: measures them in the model.
        stereo: finds depths by the photos; None to take those of the model.

    Attributes:
        marks: as they were measured.
        readings: one for each.
        proposals: of the report, measured in the same way.
        regions: surfaces with an emissivity of their own.
        stereo: as given.
    """

    def __init__(
        self, store: MarkStore, meter: MarkMeter, stereo: PhotoStereo | None = None
    ) -> None:
        self.marks = Marks()
        self.readings: list[MarkReading] = []
        self.proposals: list[MarkReading] = []
        self.stereo = stereo
        self.regions: Regions = meter.regions(self.marks)
        self._store = store
        self._meter = meter
        self._stamp: tuple[int, int] | None = None
        self._lock = threading.Lock()
        self._listeners: list[Listener] = []

    @property
    def notes(self) -> tuple[str, ...]:
        """What is assumed of the photos where a surface has an emissivity of its own."""
        return self._meter.capture.notes if self.regions else ()

    @property
    def uncertainty(self) -> UncertaintyMeter | None:
        """Of the model's temperatures; None where it is not known."""
        return self._meter.uncertainty

    def see(self, camera: Camera) -> SeenSurface:
        """The surface that marks are drawn on, from a camera."""
        return self._meter.see(camera)

    def listen(self, listener: Listener) -> None:
        """Call a function after each change."""
        with self._lock:
            self._listeners.append(listener)

    def leave(self, listener: Listener) -> None:
        """Call it no longer."""
        with self._lock:
            self._listeners = [each for each in self._listeners if each != listener]

    def refresh(self) -> None:
        """Measure what another program has changed.

        Raises:
            RunError: the file cannot be read, or holds the marks of another model.
        """
        if self._store.stamp != self._stamp:
            self._show(self._store.read())

    def add(self, kind: MarkKind, places: tuple[Place, ...], eye: Place, radius: float) -> None:
        """Add a mark under the next free name.

        Raises:
            ConfigError: it cannot be.
            RunError: it cannot be saved.
        """
        self._show(
            self._store.edit(
                lambda marks: marks.adding(Mark(marks.free_name(kind), kind, places, eye, radius))
            )
        )

    def edit(self, change: Callable[[Marks], Marks]) -> None:
        """Change the marks; errors as for ``add``."""
        self._show(self._store.edit(change))

    def undo(self) -> None:
        """Take the last change back.

        Raises:
            ConfigError: there is nothing to undo.
            RunError: it cannot be saved.
        """
        self._show(self._store.undo())

    def _show(self, marks: Marks) -> None:
        self._stamp = self._store.stamp
        self.regions = self._meter.regions(marks)
        self.readings = self._meter.measure(marks, self.regions)
        self.proposals = self._meter.measure(Marks(marks.proposals), self.regions)
        self.marks = marks
        with self._lock:
            listeners = list(self._listeners)
        for listener in listeners:
            listener()
