"""Bundle adjustment of a model with control points in place."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence

import msgspec
import numpy as np
import pycolmap

from mrgs.prepare.sfm.job import (
    ADJUSTED_FOLDER,
    CONTROL_FILE,
    MODEL_FOLDER,
    POINTS_FILE,
    REPORT_FILE,
    JobControl,
    ModelReport,
    ReconstructionJob,
    Report,
)
from mrgs.prepare.sfm.mapping import save_points
from mrgs.system.disk import read_text

MARK_WEIGHT = 30
"""A mark counts as so many features: what bends a model bends thousands of them alike."""


def adjust(job: ReconstructionJob, report: Report) -> None:
    """Adjust the model to the points of the control file, if there is one, which stay fixed.

    Their rays hold what features alone leave open: principal point and further distortion are
    refined too, and the focal length where the model's is."""
    if not (job.folder / CONTROL_FILE).is_file():
        return
    report("adjusting", 0, 0)
    control = msgspec.json.decode(read_text(job.folder / CONTROL_FILE), type=JobControl)
    model = pycolmap.Reconstruction(job.folder / MODEL_FOLDER)
    turn = pycolmap.Rotation3d(np.array(control.rotation))
    model.transform(pycolmap.Sim3d(control.scale, turn, np.array(control.translation)))
    added = _with_control(model, control)
    camera = next(iter(model.cameras.values()))
    focal, x, y, bend = camera.params
    camera.model, camera.params = pycolmap.CameraModelId.OPENCV, [focal, focal, x, y, bend, 0, 0, 0]
    config = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        config.add_image(number)
    for number in added:
        config.add_constant_point(number)
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    options.refine_focal_length = job.focal_widths is None
    options.ceres.solver_options.num_threads = 1  # threads add in any order
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    for number in added:
        model.delete_point3D(number)
    model.update_point_3d_errors()
    fresh = job.folder / f"{ADJUSTED_FOLDER}.new"
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir()
    model.write_binary(fresh)
    save_points(model, job.files, fresh / POINTS_FILE)
    before = (job.folder / MODEL_FOLDER / REPORT_FILE).read_bytes()
    after = msgspec.structs.replace(
        msgspec.json.decode(before, type=ModelReport),
        reprojection_px=model.compute_mean_reprojection_error(),
    )
    (fresh / REPORT_FILE).write_bytes(msgspec.json.encode(after))
    shutil.rmtree(job.folder / ADJUSTED_FOLDER, ignore_errors=True)
    os.replace(fresh, job.folder / ADJUSTED_FOLDER)


def _with_control(model: pycolmap.Reconstruction, control: JobControl) -> list[int]:
    """Add the control points with their marks, ``MARK_WEIGHT`` times; returns their numbers. The
    pixels of an image can be set once only, so that all points are added anew."""
    numbers = {image.name: number for number, image in model.images.items()}
    pixels = {n: [each.xy.copy() for each in model.images[n].points2D] for n in model.images}
    points = [
        (
            each.xyz.copy(),
            [(at.image_id, at.point2D_idx) for at in each.track.elements],
            each.color.copy(),
        )
        for each in model.points3D.values()
    ]
    kept = len(points)
    for place, marks in control.points * MARK_WEIGHT:
        track = []
        for file, *pixel in marks:
            track.append((numbers[file], len(pixels[numbers[file]])))
            pixels[numbers[file]].append(np.array(pixel))
        points.append((np.array(place), track, np.zeros(3, dtype=np.uint8)))
    model.delete_all_points2D_and_points3D()
    for number, found in pixels.items():
        model.images[number].points2D = [pycolmap.Point2D(pixel) for pixel in found]
    return [model.add_point3D(place, _track(seen), color) for place, seen, color in points][kept:]


def _track(elements: Sequence[tuple[int, int]]) -> pycolmap.Track:
    track = pycolmap.Track()
    for image, pixel in elements:
        track.add_element(image, pixel)
    return track
