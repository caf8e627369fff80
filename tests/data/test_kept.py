from __future__ import annotations

import hashlib
import json
import math
import os
import string
from datetime import datetime
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mrgs.data import kept
from mrgs.data.kept import MISSING, Cache, Digests, digest, fingerprint, load, save, stamps
from mrgs.data.radiometric import ExifFacts, GpsPosition, ObjectParameters, PhotoFacts
from mrgs.errors import RunError, SceneError
from mrgs.prepare.contract import (
    ConvertedImage,
    ConvertedPhotos,
    ConvertedView,
    Pairing,
    PhotoPair,
    Reconstruction,
    Skipped,
)
from mrgs.prepare.rig.contract import RigCalibration, RigView
from mrgs.scene import RGB, THERMAL, EarthPosition, PointCloud, WorldFrame
from mrgs.scene.lens import Lens

EXIF = ExifFacts("FLIR", None, datetime(2026, 3, 1, 12, 0, 0, 250_000), GpsPosition(48.1, -11.5))

names = st.text(string.ascii_letters + "ä _", min_size=1, max_size=8)
paths = names.map(Path)
contents = st.tuples(
    st.lists(st.tuples(names, st.none() | paths, paths, st.booleans())),
    st.lists(st.tuples(names, names)),
    names,
)


def pairing_of(content) -> Pairing:
    pairs, skipped, rule = content
    return Pairing(
        tuple(
            PhotoPair(
                name, {THERMAL: thermal} if rgb is None else {RGB: rgb, THERMAL: thermal}, used
            )
            for name, rgb, thermal, used in pairs
        ),
        tuple(Skipped(*item) for item in skipped),
        rule,
        (rule,),
    )


def stored_and_read(folder: Path, value, kind):
    save(folder / "result.safetensors", value, "abc")
    stored = load(folder / "result.safetensors", kind, "abc")
    assert stored is not MISSING
    return stored


@given(contents)
def test_what_is_stored_comes_back(tmp_path_factory, content):
    pairing = pairing_of(content)
    assert stored_and_read(tmp_path_factory.mktemp("stored"), pairing, Pairing) == pairing


def test_times_places_and_missing_values_come_back(tmp_path):
    views = (
        ConvertedView(
            "a",
            {
                RGB: ConvertedImage("images/a.jpg", (640, 480)),
                THERMAL: ConvertedImage("thermal/a.tiff", (320, 240), "ab12"),
            },
            EXIF,
            PhotoFacts(
                "FLIR radiometric JPEG",
                camera="E60",
                parameters=ObjectParameters(0.95, 1.0, 20.0, 20.0, 0.5, 20.0, 1.0),
                notes=("note",),
                warnings=("warning",),
            ),
            (-3.5, 41.0),
        ),
        ConvertedView("b", {THERMAL: ConvertedImage("thermal/b.png", (1, 2))}, ExifFacts()),
    )
    photos = ConvertedPhotos(views, (Skipped("c", "is cut off"),))
    assert stored_and_read(tmp_path, photos, ConvertedPhotos) == photos


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
        world=WorldFrame(True, True, EarthPosition(48.1, 11.5, None), 0.5),
    )


def test_tensors_come_back_bit_for_bit(tmp_path):
    before = reconstruction()
    after = stored_and_read(tmp_path, before, Reconstruction)
    assert list(after.viewmats) == ["a", "b"]
    assert all(torch.equal(after.viewmats[name], before.viewmats[name]) for name in "ab")
    assert torch.equal(after.points.colors, before.points.colors)
    assert [after.visible[name].tolist() for name in "ab"] == [[0, 1, 2], []]
    assert after.lenses == before.lenses
    assert after.world == before.world
    assert isinstance(after.world.origin, EarthPosition)


def test_numbers_that_are_not_finite_come_back(tmp_path):
    pose = torch.eye(4, dtype=torch.float64)
    view = RigView("a", pose, 0, math.nan, math.inf)
    rig = RigCalibration(reconstruction().lenses["a"], pose, (view,), (0.1, 0.2), 0.3, 0.4, ())
    found = stored_and_read(tmp_path, rig, RigCalibration | None)
    assert math.isnan(found.views[0].residual_px)
    assert found.views[0].uncertainty_px == math.inf
    assert stored_and_read(tmp_path, None, RigCalibration | None) is None


def test_what_was_read_does_not_change_with_the_file(tmp_path):
    """A mapped file that is cut off would even end the process."""
    pose = torch.eye(4, dtype=torch.float64)
    file = tmp_path / "result.safetensors"
    stored = stored_and_read(tmp_path, RigView("a", pose, 0, 0.1, 0.2), RigView)
    file.write_bytes(bytes(file.stat().st_size))
    assert torch.equal(stored.correction, pose)


def test_what_follows_from_something_else_is_not_taken(tmp_path):
    save(tmp_path / "result.safetensors", "value", "abc")
    assert load(tmp_path / "result.safetensors", str, "abd") is MISSING
    assert load(tmp_path / "missing.safetensors", str, "abc") is MISSING


@pytest.mark.parametrize("damage", [b"", b"{}", b"\xff" * 64, None])
def test_a_damaged_file_is_as_good_as_none(damage, tmp_path):
    file = tmp_path / "result.safetensors"
    save(file, reconstruction(), "abc")
    file.write_bytes(file.read_bytes()[:-8] if damage is None else damage)
    assert load(file, Reconstruction, "abc") is MISSING


def test_a_result_of_another_kind_is_not_taken(tmp_path):
    save(tmp_path / "result.safetensors", reconstruction(), "abc")
    assert load(tmp_path / "result.safetensors", Pairing, "abc") is MISSING


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=r"result\.safetensors cannot"):
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
    with pytest.raises(TypeError, match="set cannot be"):
        save(tmp_path / "result.safetensors", {1, 2}, "abc")


class Counted:
    """A result that counts how often it is made."""

    def __init__(self, *depends: object, file: Path | None = None) -> None:
        self.depends, self.file, self.times = depends, file, 0

    def get(self, folder: Path) -> str:
        return Cache(folder).get("a result", str, self.depends, self.make, self.files)

    def make(self) -> str:
        self.times += 1
        return "found"

    def files(self, result: str) -> list[Path]:
        return [] if self.file is None else [self.file]


def test_a_result_is_made_once(tmp_path):
    counted = Counted("photos")
    assert [counted.get(tmp_path), counted.get(tmp_path)] == ["found", "found"]
    assert counted.times == 1
    Cache(tmp_path).forget("a result")
    counted.get(tmp_path)
    assert counted.times == 2


@pytest.mark.parametrize("change", ["dependence", "damage", "missing file"])
def test_a_result_is_made_again_when_something_changed(change, tmp_path):
    file = tmp_path / "image.png"
    file.touch()
    counted = Counted("photos", file=file)
    counted.get(tmp_path)
    if change == "dependence":
        counted.depends = ("other photos",)
    elif change == "damage":
        (tmp_path / "a_result.safetensors").write_bytes(b"torn")
    else:
        file.unlink()
    counted.get(tmp_path)
    assert counted.times == 2


def test_a_result_that_was_cut_off_is_made_again(tmp_path):
    def cut_off() -> str:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Cache(tmp_path).get("result", str, (), cut_off)
    assert list(tmp_path.iterdir()) == []
    assert Cache(tmp_path).get("result", str, (), lambda: "found") == "found"


def test_stamps_tell_of_every_change(tmp_path):
    (tmp_path / "b" / "c").mkdir(parents=True)
    for name in ("z.jpg", "b/y.jpg", "b/c/x.jpg"):
        (tmp_path / name).write_text(name)
    before = stamps(tmp_path)
    assert [name for name, *_ in before] == ["b/c/x.jpg", "b/y.jpg", "z.jpg"]
    assert stamps(tmp_path) == before
    os.utime(tmp_path / "b" / "y.jpg", ns=(1, 2))
    assert [a == b for a, b in zip(stamps(tmp_path), before, strict=True)] == [True, False, True]
    (tmp_path / "z.jpg").unlink()
    assert len(stamps(tmp_path)) == 2


def test_stamps_leave_hidden_files_out_and_follow_links(tmp_path):
    photo = tmp_path / "elsewhere.jpg"
    photo.write_text("1")
    (tmp_path / "photos" / ".Trashes").mkdir(parents=True)
    (tmp_path / "photos" / ".Trashes" / "a.jpg").write_text("old")
    (tmp_path / "photos" / "a.jpg").symlink_to(photo)
    (tmp_path / "photos" / "gone.jpg").symlink_to(tmp_path / "nowhere")
    before = stamps(tmp_path / "photos")
    assert [name for name, *_ in before] == ["a.jpg", "gone.jpg"]
    photo.write_text("12")
    assert [a == b for a, b in zip(stamps(tmp_path / "photos"), before, strict=True)] == [
        False,
        True,
    ]


def test_a_folder_that_cannot_be_listed_is_named(tmp_path):
    with pytest.raises(SceneError, match="nowhere: cannot be"):
        stamps(tmp_path / "nowhere")


def test_digests_are_of_contents(tmp_path):
    for name, content in (("a", b"1"), ("b", b"1"), ("c", b"2")):
        (tmp_path / name).write_bytes(content)
    a, b, c = (digest(tmp_path / name) for name in "abc")
    assert a == b != c
    assert digest(tmp_path / "missing") == ""


class Reader:
    """Reads files, and remembers their names in order."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def __call__(self, path: Path) -> str:
        self.names.append(path.name)
        return digest(path)


@pytest.fixture
def read(monkeypatch) -> Reader:
    reader = Reader()
    monkeypatch.setattr(kept, "digest", reader)
    return reader


@pytest.fixture
def photo(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(b"abc")
    return path


def sha(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def test_a_file_is_read_once_until_it_changes(photo, tmp_path, read):
    for _ in range(2):
        digests = Digests(tmp_path / "known.json")
        assert [digests.of(photo) for _ in range(2)] == [sha(b"abc")] * 2
        digests.save()
    assert read.names == ["a.jpg"]
    status = photo.stat()
    photo.write_bytes(b"xyz")
    os.utime(photo, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert Digests(tmp_path / "known.json").of(photo) == sha(b"xyz")


def test_a_file_that_cannot_be_read_is_not_remembered(photo, tmp_path, monkeypatch):
    answers = iter(["", sha(b"abc")])
    monkeypatch.setattr(kept, "digest", lambda path: next(answers))
    digests = Digests(tmp_path / "known.json")
    assert digests.of(tmp_path / "none") == ""
    assert digests.of(photo) == ""
    assert digests.of(photo) == sha(b"abc")


def test_a_pass_that_was_cut_short_forgets_nothing(photo, tmp_path, read):
    other = tmp_path / "b.jpg"
    other.write_bytes(b"b")
    digests = Digests(tmp_path / "known.json")
    for path in (photo, other):
        digests.of(path)
    digests.save()
    photo.write_bytes(b"changed")
    digests = Digests(tmp_path / "known.json")
    digests.of(photo)
    digests.save()
    assert read.names == ["a.jpg", "b.jpg", "a.jpg"]
    digests = Digests(tmp_path / "known.json")
    assert [digests.of(path) for path in (photo, other)] == [sha(b"changed"), sha(b"b")]
    assert read.names == ["a.jpg", "b.jpg", "a.jpg"]


def test_after_a_full_pass_other_files_are_forgotten(photo, tmp_path):
    (tmp_path / "b.jpg").write_bytes(b"b")
    digests = Digests(tmp_path / "known.json")
    for name in ("a.jpg", "b.jpg"):
        digests.of(tmp_path / name)
    digests.save()
    digests = Digests(tmp_path / "known.json")
    digests.of(photo)
    digests.save(forget_others=True)
    assert list(json.loads((tmp_path / "known.json").read_text())) == [str(photo)]


@pytest.mark.parametrize("known", ["", "[]", '{"a": 1}', '{"a": [1, 2, 3]}', "[" * 100_000])
def test_a_damaged_memory_is_empty(photo, tmp_path, known, read):
    (tmp_path / "known.json").write_text(known)
    digests = Digests(tmp_path / "known.json")
    assert digests.of(photo) == sha(b"abc")
    digests.save()
    assert read.names == ["a.jpg"]
    assert Digests(tmp_path / "known.json").of(photo) == sha(b"abc")
    assert read.names == ["a.jpg"]
