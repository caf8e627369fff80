"""SIFT features of the images and their matches, into the database; then incremental mapping: poses
and points from verified matches, of which the largest model is written."""

from __future__ import annotations

import math
import os
import shutil
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
import pycolmap

from mrgs.prepare.sfm.job import (
    ADJUSTED_FOLDER,
    CONTROL_FILE,
    MODEL_FOLDER,
    POINTS_FILE,
    REPORT_FILE,
    ImageReport,
    JobControl,
    ModelReport,
    ReconstructionJob,
    Report,
)
from mrgs.prepare.sfm.pairs import (
    MAX_EXHAUSTIVE,
    MAX_MISFIT,
    MIN_IMAGES,
    are_informative,
    misfit,
    pairs_nearby,
    pairs_to_match,
)
from mrgs.system.disk import read_text
from mrgs.system.threads import available_cores

CAMERA = 1
"""Number of the camera in the database."""

CAMERA_MODEL = "SIMPLE_RADIAL"
MAX_FEATURES = 4096
FAINT_PEAK_THRESHOLD = 0.002
"""A third of COLMAP's: local maxima of the scale space as weak as this count."""

MAX_IMAGE_SIDE_PX = 1600
MAX_THREADS = 4
"""Each needs the scale space of an image, about half a gigabyte at 1600 pixels."""

_PLAUSIBLE_FOCAL_LENGTHS = (0.3, 4.0)
"""Over the image's longer side: fields of view from 118° to 14°."""


def find_features(job: ReconstructionJob, report: Report) -> None:
    """Features of all images that have none yet; an image that cannot be read stays without."""
    _write_images(job)
    with pycolmap.Database.open(job.database) as database:
        found = {
            image.name
            for image in database.read_all_images()
            if database.exists_descriptors(image.image_id)
        }
    files = [file for file in job.files if file not in found]
    done, total = len(job.files) - len(files), len(job.files)
    report("features", done, total)
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = min(available_cores(), MAX_THREADS)
    options.max_image_size = MAX_IMAGE_SIDE_PX
    options.sift.max_num_features = MAX_FEATURES
    if job.thermal:  # they have nothing as small as a pixel, so they are not enlarged
        options.sift.peak_threshold = FAINT_PEAK_THRESHOLD
        options.sift.first_octave = 0
    reader = pycolmap.ImageReaderOptions()
    reader.existing_camera_id = CAMERA
    reader.camera_model = CAMERA_MODEL
    batch = 2 * options.num_threads
    for start in range(0, len(files), batch):
        pycolmap.extract_features(
            job.database,
            job.root,
            image_names=files[start : start + batch],
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        report("features", min(done + start + batch, total), total)


def _write_images(job: ReconstructionJob) -> None:
    """The images in their order, else COLMAP would number them as its threads happen to finish,
    and the poses would differ from run to run; and their camera."""
    with pycolmap.Database.open(job.database) as database:
        if database.exists_camera(CAMERA):
            return
        camera = _camera(job)
        rig = pycolmap.Rig(rig_id=CAMERA)
        rig.add_ref_sensor(camera.sensor_id)
        with pycolmap.DatabaseTransaction(database):
            database.write_camera(camera, use_camera_id=True)
            database.write_rig(rig, use_rig_id=True)
            for number, file in enumerate(job.files, 1):
                image = pycolmap.Image(name=file, camera_id=CAMERA, image_id=number)
                frame = pycolmap.Frame(frame_id=number, rig_id=CAMERA)
                frame.add_data_id(image.data_id)
                database.write_image(image, use_image_id=True)
                database.write_frame(frame, use_frame_id=True)


def _camera(job: ReconstructionJob) -> pycolmap.Camera:
    """The camera, with its focal length if known, else the median one in its images' EXIF data,
    else COLMAP's guess."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = CAMERA_MODEL
    guesses = [pycolmap.infer_camera_from_image(job.root / file, reader) for file in job.files]
    camera = guesses[0]
    known = [guess.mean_focal_length() for guess in guesses if guess.has_prior_focal_length]
    low, high = (share * max(camera.width, camera.height) for share in _PLAUSIBLE_FOCAL_LENGTHS)
    known = [focal_length for focal_length in known if low <= focal_length <= high]
    if job.focal_widths is not None:  # of the camera held level, while images are upright
        known = [job.focal_widths * max(camera.width, camera.height)]
    camera.has_prior_focal_length = bool(known)
    guess = 1.2 * max(camera.width, camera.height)
    camera.focal_length = statistics.median(known) if known else guess
    camera.camera_id = CAMERA
    return camera


PAIRS_AT_A_TIME = 100
SEED = 0
SIFT_LENGTH = 128


def match(job: ReconstructionJob, report: Report) -> None:
    """Match all pairs that are not in the database yet."""
    pairs = pairs_to_match(len(job.files), lambda: _descriptors(job), job.positions)
    with pycolmap.Database.open(job.database) as database:
        matched = matched_pairs(database)
    waiting = [pair for pair in pairs if pair not in matched]
    report("matching", len(pairs) - len(waiting), len(pairs))
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = job.folder / "pairs.txt"
    for start in range(0, len(waiting), PAIRS_AT_A_TIME):
        lines = [
            f"{job.files[first]} {job.files[second]}\n"
            for first, second in waiting[start : start + PAIRS_AT_A_TIME]
        ]
        pairing.match_list_path.write_text("".join(lines), encoding="utf-8")
        pycolmap.match_image_pairs(
            job.database,
            matching_options=matching,
            pairing_options=pairing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
        report("matching", len(pairs) - max(len(waiting) - start - PAIRS_AT_A_TIME, 0), len(pairs))


def _descriptors(job: ReconstructionJob) -> list[np.ndarray]:
    with pycolmap.Database.open(job.database) as database:
        none = np.zeros((0, SIFT_LENGTH), dtype=np.uint8)
        return [
            database.read_descriptors(number).data if database.exists_descriptors(number) else none
            for number, _ in enumerate(job.files, 1)
        ]


def matched_pairs(database: pycolmap.Database) -> set[tuple[int, int]]:
    """The pairs of images with matches, by their places in the job; the smaller first."""
    pairs, _ = database.read_two_view_geometry_num_inliers()
    numbers = map(pycolmap.pair_id_to_image_pair, pairs)
    return {(first - 1, second - 1) for first, second in numbers}


Solver = Callable[..., Mapping[int, pycolmap.Reconstruction]]

MIN_TRACK = 3
MAX_ERROR_PX = 2.0
FEW_IMAGES = 8
"""In smaller sets, points that only two images see are used as well."""

FAINT_INITIAL_MATCHES, FAINT_POSE_MATCHES = 50, 20
"""Fewest matches of the first pair and of each further image; COLMAP's are 100 and 30."""


def map_images(
    job: ReconstructionJob, report: Report, solve: Solver = pycolmap.incremental_mapping
) -> None:
    """Compute the model unless it exists. Where no two images match, it has a report only."""
    if (job.folder / MODEL_FOLDER).is_dir():
        return
    models, nearby = _models_by_position(job, report, solve)
    if models:
        least = MIN_TRACK if len(job.files) >= FEW_IMAGES else 2
        for number, point in list(models[0].points3D.items()):
            if point.track.length() < least or point.error > MAX_ERROR_PX:
                models[0].delete_point3D(number)
    _write(job, MODEL_FOLDER, models[:1], _report(job, models, nearby))


WHOLE_LENS = 0.97
"""The whole lens is refined if features then fit better by that, else it explains their noise."""


def adjust(job: ReconstructionJob, report: Report) -> None:
    """Adjust the model to the points of the control file, if there is one, which stay in place.
    The whole lens is refined where the features call for it."""
    if not (job.folder / CONTROL_FILE).is_file():
        return
    report("adjusting", 0, 0)
    content = read_text(job.folder / CONTROL_FILE)
    similarity, points = msgspec.json.decode(content, type=JobControl)
    model = pycolmap.Reconstruction(job.folder / MODEL_FOLDER)
    model.transform(pycolmap.Sim3d(np.array(similarity)))
    config = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        config.add_image(number)
    # An image's pixels can be moved but not added to: marks take those of unused features.
    images = {image.name: image for image in model.images.values()}
    unused = {
        name: iter([n for n, pixel in enumerate(image.points2D) if not pixel.has_point3D()])
        for name, image in images.items()
    }
    added = []
    for place, marks in points:
        track = pycolmap.Track()
        for file, *pixel in marks:
            if (number := next(unused[file], None)) is not None:
                images[file].points2D[number].xy = np.array(pixel)
                track.add_element(images[file].image_id, number)
        added.append(model.add_point3D(np.array(place), track))
        config.add_constant_point(added[-1])
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.refine_focal_length = job.focal_widths is None
    options.ceres.solver_options.num_threads = 1  # threads add in any order
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    whole = pycolmap.Reconstruction(model)
    focal, x, y, k1 = model.cameras[CAMERA].params
    whole.cameras[CAMERA].model = pycolmap.CameraModelId.OPENCV
    whole.cameras[CAMERA].params = [focal, focal, x, y, k1, 0, 0, 0]
    options.refine_principal_point = True
    pycolmap.create_default_bundle_adjuster(options, config, whole).solve()
    for each in (model, whole):
        for number in added:
            each.delete_point3D(number)
        each.update_point_3d_errors()
    limit_px = WHOLE_LENS * model.compute_mean_reprojection_error()
    model = whole if whole.compute_mean_reprojection_error() < limit_px else model
    before = (job.folder / MODEL_FOLDER / REPORT_FILE).read_bytes()
    error_px = model.compute_mean_reprojection_error()
    made = msgspec.json.decode(before, type=ModelReport)
    _write(job, ADJUSTED_FOLDER, [model], msgspec.structs.replace(made, reprojection_px=error_px))


def _write(
    job: ReconstructionJob, name: str, models: Sequence[pycolmap.Reconstruction], made: ModelReport
) -> None:
    """Write a report, and the model if there is one, into a folder of the job."""
    fresh = job.folder / f"{name}.new"
    for folder in (fresh, job.folder / name):
        shutil.rmtree(folder, ignore_errors=True)
    fresh.mkdir()
    for model in models:
        model.write_binary(fresh)
        _save_points(model, job.files, fresh / POINTS_FILE)
    (fresh / REPORT_FILE).write_bytes(msgspec.json.encode(made))
    os.replace(fresh, job.folder / name)


def _models_by_position(
    job: ReconstructionJob, report: Report, solve: Solver
) -> tuple[list[pycolmap.Reconstruction], bool]:
    """The models, largest first, and whether only images taken near each other are matched in them:
    so where all matches lead to poses that contradict the positions, and these do not."""
    models = _models(job, job.database, report, solve)
    if not are_informative(job.positions) or len(job.files) > MAX_EXHAUSTIVE:
        return models, are_informative(job.positions)
    before = _misfit(job, models)
    if before <= MAX_MISFIT:
        return models, False
    nearby = _database_nearby(job)
    try:
        others = _models(job, nearby, report, solve)
    finally:
        nearby.unlink()
    agrees = _misfit(job, others) < before / 2
    return (others, True) if agrees else (models, False)


def _misfit(job: ReconstructionJob, models: Sequence[pycolmap.Reconstruction]) -> float:
    """``misfit`` of the largest model; infinite where that has less than half of the images."""
    assert job.positions is not None
    if not models or models[0].num_reg_images() < max(len(job.files) / 2, MIN_IMAGES):
        return math.inf
    places = {name: place for place, name in enumerate(job.files)}
    images = [models[0].images[number] for number in models[0].reg_image_ids()]
    centres = np.array([image.projection_center() for image in images])
    return misfit(centres, job.positions[[places[image.name] for image in images]])


def _database_nearby(job: ReconstructionJob) -> Path:
    """A copy of the database in which only images taken near each other are matched."""
    assert job.positions is not None
    copy = job.folder / "nearby.db"
    shutil.copyfile(job.database, copy)
    kept = set(pairs_nearby(job.positions))
    with pycolmap.Database.open(copy) as database:
        for first, second in matched_pairs(database) - kept:
            database.delete_two_view_geometry(first + 1, second + 1)
    return copy


def _models(
    job: ReconstructionJob, database: Path, report: Report, solve: Solver
) -> list[pycolmap.Reconstruction]:
    """All models, largest first; they share images at their borders only."""
    total, registered = len(job.files), 0

    def progress(images: int) -> None:
        nonlocal registered
        registered = min(images, total)
        report("mapping", registered, total)

    progress(0)
    folder = job.folder / "models"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = SEED
    if total <= MAX_EXHAUSTIVE:  # threads add in any order, and save little with so few images
        options.num_threads = options.mapper.num_threads = 1
    options.min_model_size = 3
    options.triangulation.ignore_two_view_tracks = total >= FEW_IMAGES
    options.ba_refine_focal_length = job.focal_widths is None
    if job.thermal:
        options.mapper.init_min_num_inliers = FAINT_INITIAL_MATCHES
        options.mapper.abs_pose_min_num_inliers = FAINT_POSE_MATCHES
    models = solve(
        database,
        job.root,
        folder,
        options,
        initial_image_pair_callback=lambda: progress(2),
        next_image_callback=lambda: progress(registered + 1),
    )
    shutil.rmtree(folder)
    return sorted(models.values(), key=lambda model: model.num_reg_images(), reverse=True)


def _save_points(model: pycolmap.Reconstruction, files: Sequence[str], file: Path) -> None:
    """Positions, colours (0 to 255), and which image sees which point: rows of (file, point)."""
    places = {name: place for place, name in enumerate(files)}
    points = [model.points3D[number] for number in sorted(model.points3D)]
    seen = {
        (places[model.images[element.image_id].name], row)
        for row, point in enumerate(points)
        for element in point.track.elements
    }
    np.savez(
        file,
        positions=np.array([point.xyz for point in points]).reshape(-1, 3),
        colors=np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
        seen=np.array(sorted(seen), dtype=np.int64).reshape(-1, 2),
    )


def _report(
    job: ReconstructionJob, models: Sequence[pycolmap.Reconstruction], nearby: bool
) -> ModelReport:
    with pycolmap.Database.open(job.database) as database:
        features = [
            database.num_keypoints_for_image(number) if database.exists_keypoints(number) else None
            for number, _ in enumerate(job.files, 1)
        ]
        pairs, inliers = database.read_two_view_geometry_num_inliers()
    best: dict[int, tuple[int, int]] = {}
    for pair, count in zip(pairs, inliers, strict=True):
        first, second = pycolmap.pair_id_to_image_pair(pair)
        for own, other in ((first, second), (second, first)):
            best[own] = max(best.get(own, (0, 0)), (count, other))
    groups = [{model.images[number].name for number in model.reg_image_ids()} for model in models]
    images = []
    for number, file in enumerate(job.files, 1):
        matches, other = best.get(number, (0, 0))
        group = next((index for index, members in enumerate(groups) if file in members), None)
        name = job.files[other - 1] if other else None
        images.append(ImageReport(features[number - 1], matches, name, group))
    error_px = models[0].compute_mean_reprojection_error() if models else None
    return ModelReport(tuple(images), tuple(map(len, groups)), error_px, nearby)
