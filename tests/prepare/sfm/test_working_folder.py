from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from mrgs.errors import RunError
from mrgs.prepare.sfm.job import read_job
from mrgs.prepare.sfm.reconstruct import set_up


def silent(step: str, done: int, of: int) -> None:
    pass


@pytest.fixture
def photos(tmp_path):
    """Three photos of one camera by name; the names would be hard on a file of words."""
    images = {}
    for index, name in enumerate(["wall 1", "wall 2", "Tür"]):
        images[name] = tmp_path / f"{name}.png"
        Image.fromarray(
            np.random.default_rng(index).integers(0, 256, (12, 16), dtype=np.uint8)
        ).save(images[name])
    return images


def test_the_folder_holds_the_images_under_numbers(photos, tmp_path):
    set_up(tmp_path / "sfm", photos, False, silent)
    job = read_job(tmp_path / "sfm")
    assert job.files == ("000001.png", "000002.png", "000003.png")
    for file, path in zip(job.files, photos.values(), strict=True):
        assert (job.root / file).read_bytes() == path.read_bytes()


def test_positions_come_with_the_images(photos, tmp_path):
    assert read_job_after(tmp_path, photos, None).positions is None
    positions = np.array([[0.0, 0, 0], [4.25, 1, 0], [8.5, 2, 1]])
    assert (read_job_after(tmp_path, photos, positions).positions == positions).all()


def read_job_after(tmp_path, photos, positions):
    set_up(tmp_path / "sfm", photos, False, silent, positions)
    return read_job(tmp_path / "sfm")


def test_what_was_made_of_the_same_images_stays(photos, tmp_path):
    folder = tmp_path / "sfm"
    set_up(folder, photos, False, silent)
    (folder / "database.db").write_text("features")
    set_up(folder, photos, False, silent)
    assert (folder / "database.db").exists()


@pytest.mark.parametrize(
    "change", ["content", "order", "thermal", "positions", "field of view", "cut off", "damaged"]
)
def test_what_was_made_of_other_images_goes(photos, tmp_path, change):
    folder = tmp_path / "sfm"
    set_up(folder, photos, False, silent)
    (folder / "database.db").write_text("features")
    if change == "content":
        photos["Tür"].unlink()
        Image.fromarray(np.zeros((12, 16), dtype=np.uint8)).save(photos["Tür"])
    if change == "order":
        photos = dict(reversed(photos.items()))
    if change == "cut off":
        (folder / "job.json").unlink()
    if change == "damaged":
        (folder / "job.json").write_bytes(b"\xff\xfe")
    positions = np.eye(3) if change == "positions" else None
    view_deg = 45.0 if change == "field of view" else None
    set_up(folder, photos, change == "thermal", silent, positions, view_deg)
    assert not (folder / "database.db").exists()
    assert len(json.loads((folder / "job.json").read_text())["images"]) == 3


def test_thermal_images_are_made_and_counted(photos, tmp_path):
    steps = []
    set_up(tmp_path / "sfm", photos, True, lambda *step: steps.append(step))
    assert steps == [("contrast", 1, 3), ("contrast", 2, 3), ("contrast", 3, 3)]
    with Image.open(tmp_path / "sfm" / "images" / "000003.png") as image:
        assert image.mode == "L"


def test_a_folder_that_cannot_be_made(photos, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="file/sfm cannot"):
        set_up(tmp_path / "file" / "sfm", photos, False, silent)
