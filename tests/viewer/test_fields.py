from __future__ import annotations

from dataclasses import replace

import numpy as np

from mrgs.scene import RGB, THERMAL
from mrgs.viewer.panes import render_pane


def test_beside_a_photo_the_camera_is_imitated(subject, small_run, camera):
    """What is looked at is what is there; what is compared with a photo is what the camera would
    have written."""
    colder = replace(
        subject,
        camera_response=lambda rendering, _: rendering.with_images(
            {THERMAL: rendering[THERMAL].image - 0.25}
        ),
    )
    looked_at = render_pane(small_run.model, camera, colder)
    compared = render_pane(small_run.model, camera, colder, as_photo_of=camera)
    expected = looked_at.images[THERMAL] - 0.25 * small_run.temperature.span_c
    np.testing.assert_allclose(compared.images[THERMAL], expected, atol=1e-4)
    np.testing.assert_array_equal(compared.images[RGB], looked_at.images[RGB])
    np.testing.assert_array_equal(compared.depth, looked_at.depth)
