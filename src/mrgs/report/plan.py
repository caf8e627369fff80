"""Where the marks are, seen from above."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from markupsafe import Markup, escape

from mrgs.marks.mark import Mark
from mrgs.scene import Scene

WIDTH, HEIGHT, MARGIN = 720, 420, 24
FONT = 'font-size="13" font-weight="600" fill="#1d2126"'
MOST_POINTS = 4000
TRIMMED_PERCENT = 1.0
"""Of the start points on each side: what strays far off does not shrink the plan."""


def draw_plan(scene: Scene, marks: Sequence[Mark]) -> Markup:
    """The start points, the cameras and the marks, looking down the scene's z axis, as SVG."""
    points = scene.points.positions.double().numpy()
    points = points[:: max(1, len(points) // MOST_POINTS), :2]
    cameras = np.array([each.position.numpy()[:2] for each in scene.train_cameras])
    places = np.array([np.mean(mark.points, axis=0)[:2] for mark in marks])
    low, high = np.percentile(points, [TRIMMED_PERCENT, 100 - TRIMMED_PERCENT], axis=0)
    low = np.minimum(low, np.concatenate([cameras, places]).min(axis=0))
    high = np.maximum(high, np.concatenate([cameras, places]).max(axis=0))
    scale = float(
        min((WIDTH - 2 * MARGIN) / (high - low)[0], (HEIGHT - 2 * MARGIN) / (high - low)[1])
    )
    inside = ((points >= low) & (points <= high)).all(axis=1)

    def on_page(at: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        middle = at - (low + high) / 2
        return np.stack([WIDTH / 2 + scale * middle[:, 0], HEIGHT / 2 - scale * middle[:, 1]], 1)

    dots = "".join(f"M{x:.0f} {y:.0f}h1" for x, y in on_page(points[inside]))
    shapes = [f'<path d="{dots}" stroke="#aab1ba" stroke-width="1.5" fill="none"/>']
    shapes += [
        f'<path d="M{x:.1f} {y - 5:.1f}l4.5 8h-9z" fill="#1f5fa8"/>' for x, y in on_page(cameras)
    ]
    for mark, (x, y) in zip(marks, on_page(places), strict=True):
        shapes.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="#c2560a" stroke="#fff"/>')
        anchor = "end" if x > WIDTH - 80 else "start"
        at = x - 8 if anchor == "end" else x + 8
        place = f'x="{at:.1f}" y="{y - 6:.1f}" text-anchor="{anchor}"'
        shapes.append(f"<text {place} {FONT}>{escape(mark.name)}</text>")
    return Markup(f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img">{"".join(shapes)}</svg>')
