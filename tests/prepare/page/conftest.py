"""A prepared scene of six views of the bundled table-top; the last has no pose."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from mrgs.data.nerfstudio import read_transforms
from mrgs.data.radiometric import PhotoFacts
from mrgs.prepare.contract import (
    ConvertedPhotos,
    Georeference,
    Pairing,
    Reconstruction,
    Skipped,
    StageReport,
)
from mrgs.prepare.convert import IMAGE_FOLDERS
from mrgs.prepare.rig.contract import RigCalibration, RigView, TargetFit
from mrgs.prepare.scene_files import write_scene
from mrgs.prepare.work import Work
from mrgs.scene import RGB, THERMAL, PointCloud
from tests.helpers.converted import converted_view

TABLETOP = Path(__file__).parents[3] / "examples" / "tabletop"
HOSTILE = "<img src=x onerror=alert(1)>&'\""
"""A name that would be markup if it were not escaped; the last view's."""


@pytest.fixture(scope="session")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Work:
    """Only to be read."""
    scene = tmp_path_factory.mktemp("prepared") / "table & chairs"
    capture = read_transforms(TABLETOP, TABLETOP / "transforms.json")
    shots = capture.views[::8]
    views = []
    for folder in IMAGE_FOLDERS.values():
        (scene / folder).mkdir(parents=True)
    for index, shot in enumerate(shots):
        stem = f"view {index}"
        files, sizes = {}, {}
        for modality, folder in IMAGE_FOLDERS.items():
            source = shot.images[modality].path
            files[modality] = f"{folder}/{stem}{source.suffix}"
            lens = shot.images[modality].lens
            sizes[modality] = lens.width, lens.height
            shutil.copy(source, scene / files[modality])
        notes = ("Emissivity 0.95, as the file says.",)
        name = HOSTILE if index == len(shots) - 1 else stem
        views.append(
            converted_view(
                name,
                files,
                sizes=sizes,
                facts=PhotoFacts("", camera="FLIR E60", notes=notes),
                range_c=(-0.5, 82.5),
            )
        )
    names = [view.name for view in views[:-1]]
    points = PointCloud(capture.points.positions[::4], capture.points.colors[::4])
    reconstruction = Reconstruction(
        {name: shot.images[RGB].viewmat for name, shot in zip(names, shots, strict=False)},
        dict.fromkeys(names, shots[0].images[RGB].lens),
        points, None, (Skipped(HOSTILE, "too few features "
                                        "<b>match</b>"),), 0.61, "Structure from motion.",
    )  # fmt: skip
    offset = torch.eye(4, dtype=torch.float64)
    offset[0, 3] = -0.031
    still = torch.eye(4, dtype=torch.float64)
    rig = RigCalibration(
        shots[0].images[THERMAL].lens,
        offset, tuple(RigView(name, still, 80, 0.5, 0.4) for name in names),
        (0.6, 1.4), 0.4, 0.2, (), TargetFit(4, (0.31, 0.7), None),
    )  # fmt: skip
    georeference = Georeference(
        1.0, still[:3, :3], torch.zeros(3).double(), True, True, None, 0.4, "By GPS."
    )
    photos = ConvertedPhotos(tuple(views), (Skipped("IMG_7.jpg", "is cut off"),))
    stages = [
        StageReport("pairs", ("6 pairs.",), ("One photo was taken a day later.",), 0.2),
        StageReport("poses", ("5 of 6 images have a pose.",), (), 312.0),
        StageReport("thermal camera", ("55.0° wide.",), (), 4.0, True),
    ]
    work = Work(scene, scene, images=photos, poses=reconstruction, rig=rig, reports=stages)
    work.pairing = Pairing(
        (), (Skipped("notes <script>alert(1)</script>.txt", "is not a photo"),), ""
    )
    work.georeference = georeference
    write_scene(work)
    return work
