"""What of a run is shown: all of it, or what its survey keeps; and how the page changes that."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from jaxtyping import Float

from mrgs.runs.open import Run, load_run
from mrgs.scene import Box
from mrgs.survey import Survey
from mrgs.viewer.source import TrainedSource

SEEN_PERCENT = 1.0, 99.0
"""A box that is drawn is around what is between these in x, y and z: single strays do not count."""

MARGIN = 0.05
"""Around that box, as a share of its longest side."""


class Keeping:
    """The part of a run that its source shows; to be called where the model may be used. ``shown``
    is the run as it is shown now, at first the one that was given."""

    def __init__(self, run: Run, source: TrainedSource) -> None:
        self.shown = run
        self._source = source
        self._survey: Survey | None = None

    @cached_property
    def _whole(self) -> Run:
        """The run before anything is left out; opened again if what was given is cropped."""
        run = self.shown
        return run if run.crop is None else load_run(run.folder.path, device="cpu")

    def follow(self, survey: Survey) -> None:
        """Show what the survey keeps, if that has changed; ConfigError if that is nothing."""
        before = self._survey or survey
        if (survey.crop, survey.crop_outlines) != (before.crop, before.crop_outlines):
            self._show(self._whole.box_in(survey))
        self._survey = survey

    def keep(self, box: Box | None) -> None:
        """Keep a box, or all, and save that; errors as for ``Run.keep``."""
        self._whole.keep(box)
        self._show(box)

    def keep_around(self, places: Float[np.ndarray, "n 3"]) -> None:
        """Keep of what is shown the box around places on the surface; errors as for ``keep``."""
        low, high = np.percentile(places, SEEN_PERCENT, axis=0)
        margin = MARGIN * (high - low).max()
        self._narrow(Box.between(*(low - margin).tolist(), *(high + margin).tolist()))

    def keep_over(self, corners: Float[np.ndarray, "n 3"]) -> None:
        """Keep of what is shown all above, below and within an outline; errors as for ``keep``."""
        z = self.shown.model.gaussians.means[:, 2]
        outline = [(x, y) for x, y, _ in corners.tolist()]
        self._narrow(Box.around(outline, z.min().item(), z.max().item()))

    def keep_between(self, sides: tuple[float, float, float, float, float, float]) -> None:
        """Move the sides of the box that is shown, as of ``Box.between``; see ``keep``."""
        shown = self.shown.crop
        self.keep(Box.between(*sides, outlines=() if shown is None else shown.outlines))

    def undo(self) -> None:
        """Undo the last change in the survey; see ``Run.undo_keep``."""
        self._whole.undo_keep()

    def _narrow(self, box: Box) -> None:
        self.keep(box if self.shown.crop is None else box.within(self.shown.crop))

    def _show(self, box: Box | None) -> None:
        self.shown = self._whole if box is None else self._whole.cropped(box)
        self._source.show(self.shown.model)
