from __future__ import annotations

import math
import string
from datetime import datetime
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mrgs.data.lens import Lens
from mrgs.data.radiometric import ExifFacts, GpsPosition
from mrgs.errors import RunError
from mrgs.prepare.contract import (
    DevelopedView,
    Development,
    LeftOut,
    Pairing,
    PhotoPair,
    Reconstruction,
)
from mrgs.prepare.rig import RigCalibration, RigView
from mrgs.prepare.store import fingerprint, load, save
from mrgs.scene import PointCloud

EXIF = ExifFacts("FLIR", None, datetime(2026, 3, 1, 12, 0, 0, 250_000), GpsPosition(48.1, -11.5))

names = st.text(string.ascii_letters + "ä _", min_size=1, max_size=8)
paths = names.map(Path)
contents = st.tuples(
    st.lists(st.tuples(names, st.none() | paths, paths, st.booleans())),
    st.lists(st.tuples(names, names)),
    names,
)


def pairing_of(content) -> Pairing:
    pairs, left_out, rule = content
    return Pairing(
        tuple(PhotoPair(*pair) for pair in pairs),
        tuple(LeftOut(*item) for item in left_out),
        rule,
        (rule,),
    )


def stored_and_read(folder: Path, value, kind):
    save(folder / "result.safetensors", value, "abc")
    stored = load(folder / "result.safetensors", kind, "abc")
    assert stored is not None
    return stored.value


@given(contents)
def test_what_is_stored_comes_back(tmp_path_factory, content):
    pairing = pairing_of(content)
    assert stored_and_read(tmp_path_factory.mktemp("stored"), pairing, Pairing) == pairing


def test_times_places_and_missing_values_come_back(tmp_path):
    views = (
        DevelopedView(
            "a",
            "images/a.jpg",
            "thermal/a.tiff",
            EXIF,
            "E60",
            (-3.5, 41.0),
            ("note",),
            ("warning",),
        ),
        DevelopedView("b", None, "thermal/b.png", ExifFacts()),
    )
    development = Development(views, (LeftOut("c", "is cut off"),))
    assert stored_and_read(tmp_path, development, Development) == development


def reconstruction() -> Reconstruction:
    viewmat = torch.eye(4, dtype=torch.float64)
    lens = Lens(320, 240, 300.0, 301.0, 160.0, 120.0, (0.1, 0.0, 0.0, 0.0))
    return Reconstruction(
        viewmats={"a": viewmat, "b": 2 * viewmat},
        lenses={"a": lens, "b": lens},
        points=PointCloud(torch.rand(5, 3), torch.rand(5, 3)),
        visible={"a": torch.arange(3), "b": torch.arange(0)},
        failed=(),
        reprojection_px=None,
        source="test",
    )


def test_tensors_come_back_bit_for_bit(tmp_path):
    before = reconstruction()
    after = stored_and_read(tmp_path, before, Reconstruction)
    assert list(after.viewmats) == ["a", "b"]
    assert all(torch.equal(after.viewmats[name], before.viewmats[name]) for name in "ab")
    assert torch.equal(after.points.colors, before.points.colors)
    assert [after.visible[name].tolist() for name in "ab"] == [[0, 1, 2], []]
    assert after.lenses == before.lenses


def test_numbers_that_are_not_finite_come_back(tmp_path):
    pose = torch.eye(4, dtype=torch.float64)
    view = RigView("a", pose, 0, math.nan, math.inf)
    rig = RigCalibration(reconstruction().lenses["a"], pose, (view,), (0.1, 0.2), 0.3, 0.4, ())
    found = stored_and_read(tmp_path, rig, RigCalibration | None)
    assert math.isnan(found.views[0].residual_px)
    assert found.views[0].uncertainty_px == math.inf
    assert stored_and_read(tmp_path, None, RigCalibration | None) is None


def test_what_follows_from_something_else_is_not_taken(tmp_path):
    save(tmp_path / "result.safetensors", "value", "abc")
    assert load(tmp_path / "result.safetensors", str, "abd") is None
    assert load(tmp_path / "missing.safetensors", str, "abc") is None


@pytest.mark.parametrize("damage", [b"", b"{}", b"\xff" * 64, None])
def test_a_damaged_file_is_as_good_as_none(damage, tmp_path):
    file = tmp_path / "result.safetensors"
    save(file, reconstruction(), "abc")
    file.write_bytes(file.read_bytes()[:-8] if damage is None else damage)
    assert load(file, Reconstruction, "abc") is None


def test_a_result_of_another_kind_is_not_taken(tmp_path):
    save(tmp_path / "result.safetensors", reconstruction(), "abc")
    assert load(tmp_path / "result.safetensors", Pairing, "abc") is None


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=r"result\.safetensors cannot be written"):
        save(tmp_path / "file" / "result.safetensors", "value", "abc")


@given(contents, contents)
def test_fingerprints_tell_values_apart(a, b):
    assert (fingerprint(pairing_of(a)) == fingerprint(pairing_of(b))) == (a == b)


def test_fingerprints_tell_tensors_apart():
    zeros = torch.zeros(4)
    assert fingerprint(zeros) == fingerprint(torch.zeros(4))
    others = [
        torch.zeros(2, 2),
        torch.zeros(4, dtype=torch.float64),
        torch.tensor([0.0, 0.0, 0.0, 1e-30]),
    ]
    assert len({fingerprint(value) for value in (zeros, *others)}) == 4


def test_what_cannot_be_stored_is_a_mistake_of_the_program(tmp_path):
    with pytest.raises(TypeError, match="set cannot be stored"):
        save(tmp_path / "result.safetensors", {1, 2}, "abc")
