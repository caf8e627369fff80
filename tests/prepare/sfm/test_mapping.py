"""Which of two mappings is kept; the mappings themselves are faked, COLMAP's database is real."""

from __future__ import annotations

import importlib.util
import json
from itertools import combinations

import numpy as np
import pytest

from mrgs.prepare.sfm.job import MODEL_FOLDER, REPORT_FILE, ReconstructionJob
from mrgs.prepare.sfm.pairs import pairs_nearby

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed (extra sfm)"
)

FLIGHT = np.array([[4.0 * x, 3.5 * y, 20.0] for y in range(6) for x in range(8)])
FOLDED = FLIGHT * [1, 0, 1] + (FLIGHT * [0, 1, 0]) % 7.0


class Image:
    def __init__(self, name: str, centre: np.ndarray) -> None:
        self.name, self._centre = name, centre

    def projection_center(self) -> np.ndarray:
        return self._centre


class Model:
    """What ``map_images`` reads of a pycolmap.Reconstruction."""

    def __init__(self, files: tuple[str, ...], centres: np.ndarray) -> None:
        self.points3D: dict[int, object] = {}
        self.images = {
            number: Image(file, centre)
            for number, (file, centre) in enumerate(zip(files, centres, strict=True), 1)
        }

    def num_reg_images(self) -> int:
        return len(self.images)

    def reg_image_ids(self) -> list[int]:
        return list(self.images)

    def compute_mean_reprojection_error(self) -> float:
        return 0.4

    def write_binary(self, folder: object) -> None:
        pass


@pytest.fixture
def job(tmp_path):
    """48 photos of a flight, all matched with all."""
    import pycolmap

    files = tuple(f"{number:06d}.jpg" for number in range(1, 49))
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 300.0, 320, 240)
        number = database.write_camera(camera)
        ids = [database.write_image(pycolmap.Image(name=f, camera_id=number)) for f in files]
        for first, second in combinations(ids, 2):
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = np.array([[0, 0], [1, 1]], np.uint32)
            database.write_two_view_geometry(first, second, geometry)
    return ReconstructionJob(tmp_path, files, False, FLIGHT)


def matched_in(path) -> set[frozenset[str]]:
    """Pairs of images that are matched in a database."""
    import pycolmap

    with pycolmap.Database.open(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        pairs, _ = database.read_two_view_geometry_num_inliers()
    return {frozenset(names[n] for n in pycolmap.pair_id_to_image_pair(pair)) for pair in pairs}


def mapped(job, by_all: np.ndarray, by_nearby: np.ndarray) -> tuple[list, bool, int]:
    """The databases that were mapped, by their matched pairs, whether the second counted, and the
    model's images."""
    from mrgs.prepare.sfm.mapping import map_images

    databases = []

    def solve(database, *settings, **callbacks):
        databases.append(matched_in(database))
        centres = by_all if database == job.database else by_nearby
        return {0: Model(job.files[: len(centres)], centres)}

    map_images(job, lambda *step: None, solve)
    report = json.loads((job.folder / MODEL_FOLDER / REPORT_FILE).read_text())
    return databases, report["nearby"], report["groups"][0]


def test_poses_that_gps_confirms_are_kept(job):
    databases, nearby, _ = mapped(job, FLIGHT, FLIGHT)
    assert databases == [matched_in(job.database)]
    assert not nearby


def test_rows_on_each_other_are_mapped_again_from_photos_taken_near_each_other(job):
    databases, nearby, _ = mapped(job, FOLDED, FLIGHT)
    assert nearby
    expected = {frozenset((job.files[a], job.files[b])) for a, b in pairs_nearby(FLIGHT)}
    assert databases[1] == expected
    assert [file.name for file in job.folder.glob("*.db")] == ["database.db"]


def test_a_second_mapping_that_fits_no_better_is_dropped(job):
    databases, nearby, _ = mapped(job, FOLDED, FOLDED)
    assert len(databases) == 2
    assert not nearby


def test_a_second_mapping_of_a_few_photos_is_dropped(job):
    _, nearby, images = mapped(job, FOLDED, FLIGHT[:20])
    assert not nearby
    assert images == 48


def test_without_positions_there_is_one_mapping(job):
    job = ReconstructionJob(job.folder, job.files, False)
    databases, nearby, _ = mapped(job, FOLDED, FLIGHT)
    assert databases == [matched_in(job.database)]
    assert not nearby
