"""What makes a random scene unusable, found before anything is rendered."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from mrgs.scene import Camera
from mrgs_synth.cameras import CameraArc
from mrgs_synth.hits import Triangles, first_hits, ray_directions
from mrgs_synth.stage import Lamp, Stage

AZIMUTHS = 7
PROBE = (32, 24)
MOST_BACKS = 0.004
"""Share of rays that may meet a surface from behind: cracks between parts."""


def probes(arc: CameraArc) -> list[Camera]:
    """Small cameras all along the arcs, and half-way between them, held still."""
    still = replace(arc, jitter_m=0.0)
    rng, cameras = np.random.default_rng(0), []
    rings = list(arc.rings)
    rings += [((a[0] + b[0]) / 2, (a[1] + b[1]) / 2) for a, b in pairwise(rings)]
    for ring in rings:
        ends = replace(still, rings=(ring,))
        cameras += ends.train(AZIMUTHS, *PROBE, rng)
        for end in arc.azimuth_deg:
            cameras += replace(ends, azimuth_deg=(end, end)).train(1, *PROBE, rng)
    return cameras


def unseen(lamps: list[Lamp], arc: CameraArc) -> tuple[Lamp, ...]:
    """Those of the lamps that lie outside of all pictures, with a margin."""
    cameras = probes(arc)
    return tuple(lamp for lamp in lamps if not any(_shows(camera, lamp) for camera in cameras))


def _shows(camera: Camera, lamp: Lamp) -> bool:
    radius = float(np.hypot(*lamp.size_m)) / 2
    at = camera.viewmat[:3, :3].numpy() @ np.array(lamp.position) + camera.viewmat[:3, 3].numpy()
    if at[2] < -radius:
        return False
    K = camera.K.numpy()
    reach = 1.15 * np.array([PROBE[0] / 2 / K[0, 0], PROBE[1] / 2 / K[1, 1]])
    outside = np.abs(at[:2]) - reach * at[2]
    return bool((outside < radius * np.sqrt(1.0 + reach**2)).all())


def faults(stage: Stage, share_seen: float) -> list[str]:
    """What is wrong with a scene; empty if nothing is.

    Args:
        stage: the scene.
        share_seen: share of every picture that must show surfaces.
    """
    triangles = Triangles.of(stage.solids)
    clearance = 5.0 * stage.cameras.jitter_m + 0.02 * min(r for _, r in stage.cameras.rings)
    found = []
    for camera in probes(stage.cameras):
        around, backs = _around(camera, triangles)
        if around < clearance:
            found.append("a camera is too near to a surface")
        if backs > MOST_BACKS:
            found.append("a camera is within a solid, or sees the back of a surface")
        found += _view_faults(camera, triangles, share_seen)
        if any(_shows(camera, lamp) for lamp in stage.lamps):
            found.append("a lamp is visible")
        if found:
            break
    return found


def _around(camera: Camera, triangles: Triangles) -> tuple[float, float]:
    """Distance from a camera to the nearest surface in 400 directions, metres, and the share of
    them in which a surface is seen from behind."""
    number = np.arange(400) + 0.5
    up, turn = 1.0 - number / 200.0, number * np.pi * (3.0 - np.sqrt(5.0))
    flat = np.sqrt(1.0 - up**2)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), up], axis=-1)
    origins = np.broadcast_to(camera.position.numpy(), directions.shape)
    distance, triangle = triangles.tree.cast(origins, directions)
    return float(distance.min()), _backs(triangles, triangle, directions)


def _backs(
    triangles: Triangles, triangle: np.ndarray, directions: Float[np.ndarray, "n 3"]
) -> float:
    hit = triangle >= 0
    a, b, c = (triangles.corners[triangle[hit], corner] for corner in range(3))
    outwards = (np.cross(b - a, c - a) * directions[hit]).sum(axis=1)
    return float((outwards > 0.0).sum() / len(directions))


def _view_faults(camera: Camera, triangles: Triangles, share_seen: float) -> list[str]:
    hits = first_hits(camera, triangles)
    seen = hits.solid >= 0
    found = []
    if seen.mean() < share_seen:
        found.append("a camera looks at nothing")
    elif len(np.unique(hits.solid[seen])) < 3:
        found.append("a camera sees fewer than three things")
    elif np.quantile(hits.depth_m[seen], 0.1) < 0.25 * np.median(hits.depth_m[seen]):
        found.append("something hides the view")
    directions = ray_directions(camera).reshape(-1, 3)
    if _backs(triangles, hits.triangle.reshape(-1), directions) > MOST_BACKS:
        found.append("a picture shows the back of a surface")
    return found
