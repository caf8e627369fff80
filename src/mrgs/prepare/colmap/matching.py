"""Matches between pairs of images, verified by epipolar geometry, into the database."""

from __future__ import annotations

import numpy as np
import pycolmap

from mrgs.prepare.colmap.job import ReconstructionJob, Report
from mrgs.prepare.colmap.pairs import pairs_to_match

PAIRS_AT_A_TIME = 100
SEED = 0
SIFT_LENGTH = 128


def match(job: ReconstructionJob, report: Report) -> None:
    """Match all pairs that are not in the database yet."""
    numbers = pairs_to_match(len(job.files), lambda: _descriptors(job), job.positions)
    pairs = [(job.files[first], job.files[second]) for first, second in numbers]
    matched = _matched(job)
    waiting = [pair for pair in pairs if frozenset(pair) not in matched]
    report("matching", len(pairs) - len(waiting), len(pairs))
    for start in range(0, len(waiting), PAIRS_AT_A_TIME):
        _match(job, waiting[start : start + PAIRS_AT_A_TIME])
        report("matching", len(pairs) - max(len(waiting) - start - PAIRS_AT_A_TIME, 0), len(pairs))


def _descriptors(job: ReconstructionJob) -> list[np.ndarray]:
    with pycolmap.Database.open(job.database) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        none = np.zeros((0, SIFT_LENGTH), dtype=np.uint8)
        return [
            database.read_descriptors(ids[file]).data if file in ids else none for file in job.files
        ]


def _matched(job: ReconstructionJob) -> set[frozenset[str]]:
    with pycolmap.Database.open(job.database) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        pairs, _ = database.read_two_view_geometry_num_inliers()
    ids = [pycolmap.pair_id_to_image_pair(pair) for pair in pairs]
    return {frozenset((names[first], names[second])) for first, second in ids}


def _match(job: ReconstructionJob, pairs: list[tuple[str, str]]) -> None:
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.guided_matching = job.faint
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = job.folder / "pairs.txt"
    pairing.match_list_path.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
    pycolmap.match_image_pairs(
        job.database,
        matching_options=matching,
        pairing_options=pairing,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )
