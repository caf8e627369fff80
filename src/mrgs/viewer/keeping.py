"""What of a run is shown: all of it, or what its survey keeps; and how the page changes that."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from jaxtyping import Float

from mrgs.runs.open import Run, load_run
from mrgs.scene import Box
from mrgs.survey import Corners, Crop, Survey
from mrgs.viewer.source import TrainedSource

SEEN_PERCENT = 1.0, 99.0
"""A box that is drawn is around what is between these in x, y and z: single strays do not count."""

MARGIN = 0.05
"""Around that box, as a share of its longest side."""


class Keeping:
    """The part of a run that its source shows, for the worker's thread. ``shown`` is the run as it
    is shown, at first the one that was given; it follows the survey when that is read."""

    def __init__(self, run: Run, source: TrainedSource) -> None:
        self.shown = run
        self._source = source
        self._followed: Crop | None = None
        self._changed = False

    @cached_property
    def _whole(self) -> Run:
        """The run before anything is left out; opened again if what was given is cropped."""
        run = self.shown
        return run if run.crop is None else load_run(run.folder.path, device="cpu")

    def follow(self, survey: Survey) -> bool:
        """Show what the survey keeps if that has changed, and whether it has. ConfigError if it
        keeps nothing."""
        if changed := self._changed or self._followed not in (None, survey.kept):
            box = self._whole.box_in(survey)
            self.shown = self._whole if box is None else self._whole.cropped(box)
            self._source.show(self.shown.model)
        self._followed, self._changed = survey.kept, False
        return changed

    def keep(self, box: Box | None) -> None:
        """State in the survey that a box is kept, or all; errors as for ``Run.keep``."""
        self._whole.keep(box)
        self._changed = True

    def keep_seen(self, places: Float[np.ndarray, "n 3"]) -> None:
        """Keep of what is shown the box around places on the surface; errors as for ``keep``."""
        low, high = np.percentile(places, SEEN_PERCENT, axis=0)
        margin = MARGIN * (high - low).max()
        self._narrow(Box.between(*(low - margin).tolist(), *(high + margin).tolist()))

    def keep_within(self, corners: Float[np.ndarray, "n 3"]) -> None:
        """Keep of what is shown all above, below and within an outline; errors as for ``keep``."""
        outlines = (tuple((x, y) for x, y, _ in corners.tolist()),)
        box = self.shown.box_in(Survey(crop_outlines=outlines))
        assert box is not None
        self._narrow(box)

    def move_sides(self, sides: Corners) -> None:
        """Keep another box within the outlines of the one that is shown; see ``keep``."""
        shown = self.shown.crop
        self.keep(Box.between(*sides, () if shown is None else shown.outlines))

    def undo(self) -> None:
        """Undo the last change in the survey; see ``Run.undo_keep``."""
        self._whole.undo_keep()
        self._changed = True

    def _narrow(self, box: Box) -> None:
        self.keep(box if self.shown.crop is None else box.within(self.shown.crop))
