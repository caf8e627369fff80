"""What reflected heat could gain: `python -m benchmarks.reflections [SEED...]`

Takes the generated tabletop with a kettle of polished steel, and the façade with panes that reflect
the sky, and knows everything about them: surfaces, normals, emissivities, temperatures. Of places
on these mirrors it compares what the held-out views read with the mean of the training views'
readings there, and with the best that one reflected temperature for each direction can say,
R = ε R(T) + (1 − ε) R(T_refl(r)), fitted to the training views: no trained model knows more. Prints
mean absolute differences, °C.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix, diags, hstack, vstack
from scipy.sparse.linalg import lsqr
from scipy.spatial import KDTree

from mrgs.scene import Camera
from mrgs_synth.facade import facade
from mrgs_synth.generate import stage_cameras
from mrgs_synth.hits import Triangles, first_hits
from mrgs_synth.planck import band_radiance, temperature
from mrgs_synth.radiometry import facing_normals, surface_reading
from mrgs_synth.stage import Solid, Stage
from mrgs_synth.tabletop import tabletop

SEEDS = (31, 32, 33)
WIDTH, HEIGHT, TRAIN_VIEWS, EVAL_VIEWS = 160, 120, 40, 8
PLACES_PER_VIEW = 80

CELLS = 3000
"""Directions of which each has a reflected temperature of its own, some 4° apart."""

DAMPING = 0.05
"""Weight that keeps the temperature of directions which few readings show near the median."""

LEAST_VIEWS = 3
"""Training views that show a place, for it to be judged."""


def steel_kettle(seed: int) -> Stage:
    """The tabletop, whose kettle is of polished steel."""
    return _with(tabletop(seed), "kettle", finish="metal", emissivity=0.12, heat_mirror=True)


def mirroring_windows(seed: int) -> Stage:
    """The façade, whose panes reflect the sky."""
    return _with(facade(seed), "glass", emissivity=0.87, heat_mirror=True)


def _with(stage: Stage, name: str, **material: object) -> Stage:
    def changed(solid: Solid) -> Solid:
        if not solid.name.startswith(name) or "handle" in solid.name:
            return solid
        return replace(solid, material=replace(solid.material, **material))

    return replace(stage, solids=tuple(map(changed, stage.solids)))


def compared(stage: Stage, seed: int) -> tuple[float, float]:
    """By how much the held-out views' readings of places on mirrors differ from the mean of the
    training views', and from the best reflected temperature by direction, °C."""
    cameras = stage_cameras(stage, WIDTH, HEIGHT, TRAIN_VIEWS, EVAL_VIEWS, seed)
    triangles = Triangles.of(stage.solids)
    held_out = [camera for name, camera in cameras.items() if "_eval_" in name]
    places, triangle = _places(stage, triangles, held_out, np.random.default_rng(seed))
    seen = [_readings(stage, triangles, places, triangle, each) for each in cameras.values()]
    place = np.concatenate([rows for rows, _, _ in seen])
    reading, direction = (np.concatenate([each[k] for each in seen]) for k in (1, 2))
    train = np.repeat(["_train_" in name for name in cameras], [len(rows) for rows, *_ in seen])
    views = np.bincount(place[train], minlength=len(places))
    judged = ~train & (views >= LEAST_VIEWS)[place]
    mean = np.bincount(place[train], reading[train], len(places)) / views.clip(1)
    emissivity = np.array([solid.material.emissivity for solid in stage.solids])
    share = 1 - emissivity[triangles.solid[triangle[place]]]
    fitted = _by_direction(place, reading, direction, share, train)
    return (
        float(np.abs(reading - mean[place])[judged].mean()),
        float(np.abs(reading - fitted)[judged].mean()),
    )


def _places(
    stage: Stage, triangles: Triangles, cameras: list[Camera], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Random places on mirrors that cameras see, and their triangles."""
    mirror = np.array([solid.material.heat_mirror for solid in stage.solids])
    points, found = [], []
    for camera in cameras:
        hits = first_hits(camera, triangles)
        there = np.flatnonzero((hits.solid >= 0) & mirror[hits.solid])
        chosen = rng.choice(there, min(PLACES_PER_VIEW, len(there)), replace=False)
        points.append(hits.points.reshape(-1, 3)[chosen])
        found.append(hits.triangle.ravel()[chosen])
    return np.concatenate(points), np.concatenate(found)


def _readings(
    stage: Stage,
    triangles: Triangles,
    places: Float[np.ndarray, "n 3"],
    triangle: Int[np.ndarray, " n"],
    camera: Camera,
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"], Float[np.ndarray, "k 3"]]:
    """The places that a camera sees, what it reads there, °C, and the mirrored directions."""
    rays = places - camera.position.numpy()
    away = np.linalg.norm(rays, axis=1)
    rays /= away[:, None]
    reached, _ = triangles.tree.cast(np.broadcast_to(camera.position.numpy(), rays.shape), rays)
    rows = np.flatnonzero(np.abs(reached - away) < 1e-3 * away)
    there = triangle[rows], places[rows], rays[rows]
    normals = facing_normals(triangles, *there)
    mirrored = rays[rows] - 2 * (rays[rows] * normals).sum(axis=1, keepdims=True) * normals
    return rows, surface_reading(stage, triangles, *there), mirrored


def _by_direction(
    place: Int[np.ndarray, " k"],
    reading: Float[np.ndarray, " k"],
    direction: Float[np.ndarray, "k 3"],
    share: Float[np.ndarray, " k"],
    train: np.ndarray,
) -> Float[np.ndarray, " k"]:
    """Readings by a radiance of each place and one of each direction, whose share is 1 − ε: the
    least squares over the training views, °C."""
    count = np.arange(CELLS) + 0.5  # evenly over the sphere, on a spiral
    z, turn = 1 - 2 * count / CELLS, np.pi * (1 + np.sqrt(5)) * count
    cells = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], 1)
    cell = KDTree(cells).query(direction)[1]
    rows, shape = np.arange(len(place)), (len(place), place.max() + 1)
    reflected = csr_matrix((share, (rows, cell)), shape=(len(place), CELLS))
    own = csr_matrix((np.ones(len(place)), (rows, place)), shape=shape)
    unit = band_radiance(np.array(27.0))
    radiance = band_radiance(reading) / unit
    middle = np.median(radiance)
    system = hstack([reflected, own]).tocsr()
    damped = hstack([diags(np.full(CELLS, DAMPING)), csr_matrix((CELLS, shape[1]))])
    wanted = np.concatenate([(radiance - middle)[train], np.zeros(CELLS)])
    solution = lsqr(vstack([system[train], damped]), wanted, iter_lim=400)[0]
    return temperature(unit * (system @ solution + middle))


if __name__ == "__main__":
    print("scene, seed: from the mean of the training views; from one temperature by direction")
    for make in (steel_kettle, mirroring_windows):
        for seed in map(int, sys.argv[1:] or SEEDS):
            mean, by_direction = compared(make(seed), seed)
            print(f"{make.__name__}, {seed}: {mean:.2f}; {by_direction:.2f} °C")
