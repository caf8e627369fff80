"""The picture of the uncertainty where a surface has an emissivity of its own."""

from __future__ import annotations

import numpy as np

from mrgs.scene import THERMAL
from mrgs.viewer.inspection import Inspection
from mrgs.viewer.settings import Settings
from tests.helpers.subjects import MODES


def test_a_surface_with_settings_of_its_own_has_their_uncertainty(subject, camera):
    board = subject.board
    before = subject.uncertainty(camera)
    rows, columns = np.nonzero(before.solid)
    row, column = float(np.median(rows)), float(np.median(columns))
    picked = board.picker.pick("box", camera, [(column - 4, row - 4), (column + 5, row + 5)])
    board.edit(lambda marks: marks.adding("box", **picked, emissivity=0.4, reflected_c=0.0))
    after = subject.uncertainty(camera)
    changed = after.images[THERMAL] != before.images[THERMAL]
    changed &= before.solid
    assert 20 < changed.sum() < 150
    assert (after.images[THERMAL][changed] > before.images[THERMAL][changed] + 1).all()


def test_the_picture_of_uncertainty_has_the_areas_that_that_of_temperatures_has(subject, camera):
    """An area that is seen at a slant, on a surface whose depths are uneven."""
    inspection, board = Inspection(subject), subject.board
    aside = camera.look_at((2.0, 1.0, 2.4), (0.0, 0.0, 0.0))

    def pictures() -> tuple[np.ndarray, np.ndarray]:
        of_mode = []
        for mode in ("temperature", "uncertainty"):
            inspection.settings = Settings(MODES[mode])
            (images,) = inspection.picture(aside).images
            of_mode.append(np.where(images.solid, images.images[THERMAL], np.nan))
        return of_mode[0], of_mode[1]

    before = pictures()
    picked = board.picker.pick("box", camera, [(66, 46), (94, 74)])
    board.edit(lambda marks: marks.adding("box", **picked, emissivity=0.4, reflected_c=0.0))
    changed = [now != then for now, then in zip(pictures(), before, strict=True)]
    known = np.isfinite(before[0]) & np.isfinite(before[1])
    assert 100 < (changed[0] & known).sum() < known.sum() - 100
    assert (changed[0] == changed[1])[known].all()
