"""The picture of the uncertainty where a surface has an emissivity of its own."""

from __future__ import annotations

import numpy as np

from mrgs.scene import THERMAL


def test_a_surface_with_settings_of_its_own_has_their_uncertainty(subject, camera):
    board = subject.board
    before = subject.uncertainty(camera)
    rows, columns = np.nonzero(before.solid)
    row, column = float(np.median(rows)), float(np.median(columns))
    board.draw("box", camera, [(column - 4, row - 4), (column + 5, row + 5)])
    (mark,) = board.marks.marks
    board.edit(lambda marks: marks.changing(mark.name, emissivity=0.4, reflected_c=0.0))
    after = subject.uncertainty(camera)
    changed = after.images[THERMAL] != before.images[THERMAL]
    changed &= before.solid
    assert 20 < changed.sum() < 150
    assert (after.images[THERMAL][changed] > before.images[THERMAL][changed] + 1).all()
