"""Photos of which only a part counts."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import torch

from mrgs.blocks.plan import only
from mrgs.blocks.region import Rectangle
from mrgs.scene import RGB, Camera, Pixels, PointCloud, PosedImage, Scene, View


def test_a_look_at_a_photo_counts_where_the_photo_does():
    camera = Camera(torch.eye(3, dtype=torch.float64), torch.eye(4, dtype=torch.float64), 8, 4)
    image = PosedImage(
        camera,
        lambda: Pixels(torch.zeros(4, 8, 3)),
        load_at_least=lambda width: Pixels(torch.zeros(2, width, 3)),
    )
    points = PointCloud(torch.zeros(1, 3), torch.zeros(1, 3))
    scene = Scene("s", (View("a", {RGB: image}),), (), points, None)
    left = np.array([[True, False]])
    surveyor = SimpleNamespace(
        places=lambda camera, modality: SimpleNamespace(counted=lambda region: left)
    )
    masked = only(scene, Rectangle((0.0, 0.0), (1.0, 1.0)), [0], surveyor).train[0].images[RGB]
    for pixels, width in [(masked.load(), 8), (masked.look(4), 4)]:
        assert pixels.values.shape[1] == width
        assert pixels.valid[:, : width // 2].all()
        assert not pixels.valid[:, width // 2 :].any()
