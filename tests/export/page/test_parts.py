"""Parts of the page's model, with fewer splats than they have in earnest."""

from __future__ import annotations

import gzip
import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from mrgs.export.page.packing import ROW, PageModel, PagePart
from mrgs.scene import RGB, THERMAL

PART = 150
MODALITIES = (THERMAL, RGB)


@pytest.fixture
def model(baked, cameras) -> PageModel:
    return PageModel(baked, MODALITIES, cameras["view 3"], PART)


def centres(part: PagePart) -> np.ndarray:
    """What a part holds of the splats' places, [N, 3]."""
    header, stream, at = part.packed.header, gzip.decompress(part.packed.data), 0
    planes = {}
    for name, kind, length in header["planes"]:
        planes[name] = np.frombuffer(stream, np.dtype(kind).newbyteorder("<"), length, at)
        at += planes[name].nbytes
    chunks = np.arange(header["count"]) // header["chunk"]
    low, high = (planes[name].reshape(-1, 3)[chunks] for name in ("chunk_low", "chunk_high"))
    return low + (high - low) * planes["positions"].reshape(3, -1).T / 65535


def test_every_splat_is_in_one_of_the_parts(model, baked):
    coarse, *fine = model.parts()
    assert [part.packed.header["count"] for part in fine] == [PART] * 4
    found = np.concatenate([centres(part) for part in fine])
    rows = np.linalg.norm(found[:, None] - baked.means.numpy(), axis=2).argmin(axis=1)
    assert sorted(rows) == list(range(600))
    assert coarse.packed.header["count"] < 0.05 * 600


def test_each_part_replaces_the_coarse_splats_that_stand_for_it(model):
    coarse, *fine = model.parts()
    ends = [end for part in fine for end in part.replaces]
    assert ends[0] == 0
    assert ends[1:-1:2] == ends[2::2]
    assert ends[-1] == coarse.packed.header["count"]
    places = centres(coarse)
    for part in fine:
        theirs = places[slice(*part.replaces)].mean(axis=0)
        distances = [np.linalg.norm(theirs - centres(each).mean(axis=0)) for each in fine]
        assert np.argmin(distances) == fine.index(part)


def test_parts_lie_in_rows_of_their_own(model):
    places = [(part.first, part.first + part.packed.header["count"]) for part in model.parts()]
    assert all(first % ROW == 0 for first, _ in places)
    assert all(end <= first for (_, end), (first, _) in itertools.pairwise(places))
    dilation = {"px2": 0.1, "finest_focal_px": 107.0, "least_px2": 0.01}
    counted = {"count": 600, "parts": 5, "slots": 5 * ROW, "dilation": dilation}
    assert {name: model.facts[name] for name in counted} == counted
    assert places[-1][1] <= model.facts["slots"]


def test_the_parts_before_the_camera_come_first(baked, cameras):
    means = baked.means.clone()
    camera = cameras["view 3"]
    away = torch.arange(600) % 2 == 0
    means[away] += (camera.position - 4 * camera.viewmat[2, :3]).float()  # behind the camera
    _, *fine = PageModel(replace(baked, means=means), MODALITIES, camera, PART).parts()
    seen = [camera.contains(camera.project(torch.tensor(centres(p)))[0]).sum() for p in fine]
    assert seen[0] > 0
    assert seen[-1] == 0


def test_a_small_model_is_one_part_as_it_was(baked, cameras):
    model = PageModel(baked, MODALITIES, cameras["view 3"])
    (only,) = model.parts()
    assert model.facts["parts"] == 1
    assert (only.first, only.replaces) == (0, (0, 0))
    text = only.to_json()
    assert json.loads(text)["header"]["count"] == 600
    assert "<" not in text
