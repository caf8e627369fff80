"""SIFT features of the images, into the database."""

from __future__ import annotations

import statistics

import numpy as np
import pycolmap

from mrgs.prepare.sfm.job import ReconstructionJob, Report
from mrgs.prepare.sfm.pairs import pairs_to_match
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
