"""The sparse points that structure from motion would find: surface points that several cameras
see."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, UInt8

from mrgs.scene import Camera
from mrgs_synth.hits import Hits

MIN_CAMERAS = 2
DEPTH_TOLERANCE = 0.01


def sparse_points(
    cameras: Sequence[Camera],
    hits: Sequence[Hits],
    photos: Sequence[UInt8[np.ndarray, "h w 3"]],
    count: int,
    noise_m: float,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Draw at most ``count`` points from the pixels of the cameras, evenly, and stray from the
    surface.

    Args:
        cameras: the training cameras.
        hits: what each of them sees first, at the size of its photo.
        photos: their photos, for the colours.
        count: how many points to keep.
        noise_m: standard deviation of each coordinate, metres.
        rng: chooses the pixels and the noise.

    Returns:
        Positions in metres and colours; every point is seen by two cameras or more.
    """
    positions, colors = [], []
    for number, (hit, photo) in enumerate(zip(hits, photos, strict=True)):
        rows, columns = np.nonzero(hit.solid >= 0)
        chosen = rng.choice(
            len(rows), size=min(len(rows), 2 * count // len(cameras) + 1), replace=False
        )
        points = hit.points[rows[chosen], columns[chosen]]
        seen = 1 + sum(
            visible(points, cameras[other], hits[other]).astype(int)
            for other in range(len(cameras))
            if other != number
        )
        kept = seen >= MIN_CAMERAS
        positions.append(points[kept])
        colors.append(photo[rows[chosen], columns[chosen]][kept])
    all_positions, all_colors = np.concatenate(positions), np.concatenate(colors)
    order = rng.permutation(len(all_positions))[:count]
    return all_positions[order] + rng.normal(0.0, noise_m, (len(order), 3)), all_colors[order]


def visible(points: Float[np.ndarray, "n 3"], camera: Camera, hits: Hits) -> Bool[np.ndarray, " n"]:
    """Whether points lie in a camera's image, and at the depth of what it sees there to within 1
    %."""
    in_camera = points @ camera.viewmat[:3, :3].numpy().T + camera.viewmat[:3, 3].numpy()
    z = np.maximum(in_camera[:, 2], 1e-9)
    pixel = (in_camera / z[:, None]) @ camera.K.numpy().T
    column, row = np.floor(pixel[:, 0]), np.floor(pixel[:, 1])
    inside = (
        (in_camera[:, 2] > 0)
        & (column >= 0)
        & (column < camera.width)
        & (row >= 0)
        & (row < camera.height)
    )
    seen: Bool[np.ndarray, " n"] = np.zeros(len(points), dtype=bool)
    depth = hits.depth_m[row[inside].astype(int), column[inside].astype(int)]
    seen[inside] = np.abs(depth - z[inside]) < DEPTH_TOLERANCE * z[inside]
    return seen
