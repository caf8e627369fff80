from __future__ import annotations

import errno
import json
import os
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mrgs.data.kept import Cache
from mrgs.data.radiometric import Overrides, read_thermal_photo
from mrgs.errors import RunError, SceneError
from mrgs.prepare import PrepareOptions, convert, stages
from mrgs.prepare.contract import ConvertedPhotos, Pairing, PhotoPair
from mrgs.prepare.convert import CONTENTS, convert_photos
from mrgs.prepare.pairs.find import find_pairs
from mrgs.prepare.work import Work
from mrgs.scene import RGB, THERMAL
from tests.helpers.flir import FlirPhoto
from tests.helpers.photos import photo

NOON = datetime(2024, 5, 1, 12, 0, 0)


def quiet(step: str, done: int, total: int) -> None:
    """No progress is shown."""


def converted(
    pairing: Pairing, scene: Path, overrides: Overrides | None = None, progress=quiet, **options
) -> ConvertedPhotos:
    cache = Cache(scene / "prepare")
    return convert_photos(pairing, scene, overrides or Overrides(), cache, progress, **options)


@pytest.fixture
def scene(tmp_path) -> Path:
    return tmp_path / "scene"


@pytest.fixture
def made(photos, scene):
    """Writes photos, pairs and converts them."""

    def make(files: dict[str, object], overrides: Overrides | None = None) -> ConvertedPhotos:
        return converted(find_pairs(photos(files)), scene, overrides)

    return make


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image)


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_flir_photo_and_its_visible_photo(made, scene, photos):
    found = made({"FLIR1.jpg": ("flir with visible", {"taken": NOON, "model": "E60"})})
    (view,) = found.views
    assert (view.name, *(image.file for image in view.images.values())) == (
        "FLIR1",
        "images/FLIR1.jpg",
        "thermal/FLIR1.tiff",
    )
    truth = read_thermal_photo(photos({}) / "FLIR1.jpg")
    written = pixels(scene / view.images[THERMAL].file)
    assert written.dtype == np.float32
    np.testing.assert_array_equal(written, truth.temperature_c)
    assert (scene / view.images[RGB].file).read_bytes() == truth.facts.visible.data
    assert view.range_c == (float(written.min()), float(written.max()))
    assert (view.facts.camera, view.exif.model, view.exif.taken) == ("Test Camera", "E60", NOON)
    assert found.skipped == found.warnings == ()


def test_pixels_without_temperature_are_nan(made, scene):
    raw = FlirPhoto().raw
    raw[3, 4] = 0
    (view,) = made({"a.jpg": FlirPhoto(raw=raw).jpeg()}).views
    assert np.isnan(pixels(scene / view.images[THERMAL].file)).nonzero() == (
        np.array([3]),
        np.array([4]),
    )
    assert view.range_c is not None
    assert np.isfinite(view.range_c).all()
    assert any("0.1 %" in warning for warning in view.facts.warnings)


def test_upright_photos_keep_their_bytes(made, scene, photos):
    files = {
        "rgb/a.JPG": ("jpg", {"taken": NOON, "model": "X100"}),
        "rgb/b.jpeg": "jpg",
        "thermal/a.tif": "celsius",
    }
    found = made({**files, "thermal/b.tif": "celsius"})
    root = photos({})
    assert [view.images[RGB].file for view in found.views] == ["images/a.jpg", "images/b.jpg"]
    assert (scene / "images/a.jpg").read_bytes() == (root / "rgb/a.JPG").read_bytes()
    assert (found.views[0].exif.model, found.views[0].exif.taken) == ("X100", NOON)
    assert (
        found.views[0].facts.record.taken == NOON
    )  # of the RGB photo, where the thermal says none
    (note,) = found.views[0].facts.notes
    assert "celsius" in note


def test_a_tiff_photo_becomes_a_png(made, scene, photos):
    colours = np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3)
    root = photos({})
    (root / "rgb").mkdir()
    Image.fromarray(colours).save(root / "rgb/a.tif")
    (view,) = made({"thermal/a.png": "png"}).views
    assert view.images[RGB].file == "images/a.png"
    np.testing.assert_array_equal(pixels(scene / "images/a.png"), colours)


@pytest.mark.parametrize("orientation", range(2, 9))
def test_a_rotated_photo_is_turned_in_its_pixels(made, scene, orientation):
    rgb = ("jpg", {"size": (32, 16), "orientation": orientation, "model": "X100", "focal_mm": 23.0})
    (view,) = made({"rgb/a.jpg": rgb, "thermal/a.tif": "celsius"}).views
    with Image.open(scene.parent / "card/rgb/a.jpg") as image:
        upright = np.asarray(image.transpose(turn_by_exif(orientation)), dtype=int)
    with Image.open(scene / view.images[RGB].file) as image:
        assert image.format == "JPEG"
        assert 0x0112 not in image.getexif()
        assert image.getexif()[0x0110] == "X100"
        assert image.getexif().get_ifd(0x8769)[0x920A] == 23.0
        written = np.asarray(image, dtype=int)
    assert written.shape == upright.shape
    assert np.abs(written - upright).mean() < 2


@pytest.mark.parametrize(
    ("orientation", "expected"), [(1, 40.0), (3, 40.0), (6, 20.63), (8, 20.63)]
)
def test_a_stated_field_of_view_is_that_of_the_upright_photo(
    made, monkeypatch, orientation, expected
):
    def wide(path, overrides):
        found = read_thermal_photo(path, overrides)
        return replace(found, facts=found.facts.adding(field_of_view_deg=40.0))

    monkeypatch.setattr(convert, "read_thermal_photo", wide)
    turn = {"size": (32, 16), "orientation": orientation}
    (view,) = made({"rgb/a.jpg": ("jpg", turn), "thermal/a.tif": ("celsius", turn)}).views
    assert view.facts.field_of_view_deg == pytest.approx(expected, abs=0.01)


def turn_by_exif(orientation: int) -> Image.Transpose:
    """By what EXIF defines: where the first row and the first column of the pixels are shown."""
    return {
        2: Image.Transpose.FLIP_LEFT_RIGHT,
        3: Image.Transpose.ROTATE_180,
        4: Image.Transpose.FLIP_TOP_BOTTOM,
        5: Image.Transpose.TRANSPOSE,
        6: Image.Transpose.ROTATE_270,
        7: Image.Transpose.TRANSVERSE,
        8: Image.Transpose.ROTATE_90,
    }[orientation]


def with_exif(photo: bytes, tags: dict[int, tuple[int, int, bytes]]) -> bytes:
    """A JPEG with an EXIF of tags (type, count, value) as they are, and FocalLength 23 mm."""
    main = {**tags, 0x8769: (4, 1, struct.pack("<L", 8 + 2 + 12 * (len(tags) + 1) + 4))}
    rational = 8 + 2 + 12 * len(main) + 4 + 2 + 12 + 4
    tiff = b"II*\0" + struct.pack("<L", 8)
    for entries in (main, {0x920A: (5, 1, struct.pack("<L", rational))}):
        tiff += struct.pack("<H", len(entries))
        for tag, (kind, count, value) in sorted(entries.items()):
            tiff += struct.pack("<HHL", tag, kind, count) + value.ljust(4, b"\0")
        tiff += bytes(4)
    exif = b"Exif\0\0" + tiff + struct.pack("<LL", 23, 1)
    start = 2 + 2 + struct.unpack(">H", photo[4:6])[0]  # after JFIF's segment
    return photo[:start] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + photo[start:]


@pytest.mark.parametrize(
    "damaged",
    [
        {0x011A: (2, 3, b"72\0")},  # XResolution as text
        {0x0128: (2, 2, b"2\0")},  # ResolutionUnit as text
        {0x0128: (8, 1, struct.pack("<h", -1))},
        {0x010F: (3, 1, b"\1\0")},  # Make as a number
    ],
)
def test_damaged_exif_does_not_keep_a_photo_from_being_turned(made, scene, damaged):
    tags = {0x0110: (2, 4, b"X10\0"), 0x0112: (3, 1, b"\6\0")}
    jpeg = with_exif(photo("jpg", size=(32, 16)), tags | damaged)
    made({"rgb/a.jpg": jpeg, "thermal/a.tif": "celsius"})
    with Image.open(scene / "images/a.jpg") as image:
        assert image.size == (16, 32)
        assert dict(image.getexif()).keys() == {0x0110, 0x8769}
        assert image.getexif()[0x0110] == "X10"
        assert image.getexif().get_ifd(0x8769) == {0x920A: 23.0}


def test_exif_that_cannot_be_written_is_left_away(made, scene, monkeypatch):
    def refuse(exif: Image.Exif, offset: int = 8) -> bytes:
        raise struct.error

    rgb = photo("jpg", orientation=3, model="X100")  # written before it is refused
    with monkeypatch.context() as patch:
        patch.setattr(Image.Exif, "tobytes", refuse)
        made({"rgb/a.jpg": rgb, "thermal/a.tif": photo("celsius")})
    with Image.open(scene / "images/a.jpg") as image:
        assert not image.getexif()


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_images_with_given_poses_stay_as_they_are_stored(photos, scene, orientation):
    turn = {"size": (32, 16), "orientation": orientation}
    root = photos({"rgb/a.jpg": ("jpg", turn), "thermal/a.png": ("png", turn)})
    (view,) = converted(find_pairs(root), scene, turn=False).views
    stored = pixels(root / "rgb/a.jpg").astype(int)
    written = pixels(scene / view.images[RGB].file).astype(int)
    assert written.shape == stored.shape
    assert np.abs(written - stored).mean() < 2
    np.testing.assert_array_equal(
        pixels(scene / view.images[THERMAL].file), pixels(root / "thermal/a.png")
    )


def test_prepare_turns_images_only_where_it_finds_the_poses(photos, scene):
    root = photos(
        {"rgb/a.jpg": ("jpg", {"size": (32, 16), "orientation": 6}), "thermal/a.tif": "celsius"}
    )
    for poses, shape in ((None, (32, 16, 3)), (scene, (16, 32, 3))):
        work = Work(root, scene, PrepareOptions(poses=poses), pairing=find_pairs(root))
        work.run("images", stages.images)
        assert not work.reports[0].reused
        (view,) = work.images.views
        assert pixels(scene / view.images[RGB].file).shape == shape


def test_all_photos_are_turned_as_most_of_them(made, scene):
    """Photos of one camera keep one lens, whichever way it was held."""
    rgb = {
        f"rgb/{i}.jpg": ("jpg", {"size": (32, 16), "orientation": (1, 6, 6)[i]}) for i in range(3)
    }
    found = made(rgb | {f"thermal/{i}.tif": "celsius" for i in range(3)})
    assert {pixels(scene / view.images[RGB].file).shape for view in found.views} == {(32, 16, 3)}


def test_thermal_photos_are_turned_too(made, scene):
    (view,) = made(
        {"a_t.png": ("png", {"size": (32, 16), "orientation": 6}), "a_rgb.jpg": "jpg"}
    ).views
    np.testing.assert_array_equal(
        pixels(scene / view.images[THERMAL].file),
        np.rot90(pixels(scene.parent / "card/a_t.png"), -1),
    )


def test_photos_without_temperatures_still_train(made, scene):
    found = made({"rgb/a.jpg": "jpg", "thermal/a.png": "png"})
    (view,) = found.views
    assert (view.images[THERMAL].file, view.range_c) == ("thermal/a.png", None)
    np.testing.assert_array_equal(
        pixels(scene / view.images[THERMAL].file), pixels(scene.parent / "card/thermal/a.png")
    )
    assert found.warnings == ()
    (warning,) = view.facts.warnings
    assert "relative values" in warning
    assert "bounds" in warning


def test_bounds_make_temperatures_of_grey(made, scene):
    files = {"rgb/a.jpg": "jpg", "thermal/a.png": "png"}
    made(files)
    (view,) = made(files, Overrides(bounds_c=(-10.0, 40.0))).views
    assert view.range_c == (-10.0, 40.0)
    assert sorted(contents(scene / "thermal")) == ["a.tiff"]  # the grey image of before is gone


def counts(value: float) -> np.ndarray:
    return np.linspace(value, value + 300, 16 * 12).reshape(12, 16).astype(np.uint16)


def test_one_set_has_one_unit(made, photos, scene):
    """The second photo alone could be °C × 100 or K × 10."""
    root = photos({})
    for name, values in (("a", counts(2000)), ("b", counts(2900))):
        Image.fromarray(values).save(root / f"{name}_t.png")
    found = made({"a_rgb.jpg": "jpg", "b_rgb.jpg": "jpg"})
    assert [view.range_c for view in found.views] == [(20.0, 23.0), (29.0, 32.0)]
    assert all("celsius*100" in note for view in found.views for note in view.facts.notes)
    assert all(view.facts.notes for view in found.views)


def test_photos_of_an_uncertain_unit_are_read_when_a_later_one_settles_it(made, photos, scene):
    root = photos({})
    for name, values in (("a", counts(2900)), ("b", counts(2000))):
        Image.fromarray(values).save(root / f"{name}_t.png")
    found = made({"a_rgb.jpg": "jpg", "b_rgb.jpg": "jpg"})
    assert [view.range_c for view in found.views] == [(29.0, 32.0), (20.0, 23.0)]
    assert found.skipped == ()


R_JPEGS = {
    f"DJI_{i}_{mark}.JPG": ("dji" if mark == "T" else "jpg", {"model": "DJI M3T"})
    for i in (1, 2)
    for mark in "TW"
}


def install_dji_tool(folder: Path) -> None:
    """A stand-in for the program of DJI's SDK, to which every pixel is at 20 °C."""
    tool = folder / "dji_irp"
    tool.write_text(
        f"#!{sys.executable}\n"
        "import struct, sys\n"
        "with open(sys.argv[sys.argv.index('-o') + 1], 'wb') as file:\n"
        "    file.write(640 * 512 * struct.pack('<f', 20))\n"
    )
    tool.chmod(0o755)


def test_r_jpegs_have_no_unit_to_guess(made, monkeypatch, tmp_path):
    install_dji_tool(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert [view.facts.notes for view in made(R_JPEGS).views] == [(), ()]


def test_photos_with_and_without_temperatures_are_not_mixed(made, scene):
    found = made({"a_t.tif": "celsius", "a_rgb.jpg": "jpg", "b_t.png": "png", "b_rgb.jpg": "jpg"})
    assert [view.name for view in found.views] == ["a"]
    (left,) = found.skipped
    assert left.name == "b"
    assert "no temperatures" in left.reason
    assert sorted(contents(scene / "images")) == ["a.jpg"]


def test_parameters_that_differ_are_told(made):
    parameters = FlirPhoto().parameters
    content = {
        f"{i}.jpg": FlirPhoto(
            parameters={**parameters, "emissivity": value, "window_c": 20.0 + i}
        ).jpeg()
        for i, value in enumerate((0.9, 0.95))
    }
    (warning,) = made(content).warnings
    assert "Emissivity" in warning
    assert "0.9 to 0.95" in warning
    assert made(content, Overrides(emissivity=0.9)).warnings == ()


def test_a_bad_photo_is_left_out(made, scene):
    files = {
        f"{i}_{mark}": kind
        for i in range(4)
        for mark, kind in (("t.tif", "celsius"), ("rgb.jpg", "jpg"))
    }
    files["1_rgb.jpg"] = photo("jpg", size=(16, 12))[:-30]
    files["2_t.tif"] = photo("celsius")[:300]
    found = made(files)
    assert [view.name for view in found.views] == ["0", "3"]
    assert [item.name for item in found.skipped] == ["1", "2"]
    assert "1_rgb.jpg" in found.skipped[0].reason
    assert "2_t.tif" in found.skipped[1].reason
    assert sorted(contents(scene / "images")) == ["0.jpg", "3.jpg"]


def test_no_photo_that_can_be_used(made):
    with pytest.raises(SceneError, match=r"none of the 2 .*1_T\.JPG: .*R-JPEG"):
        made(R_JPEGS)


def test_no_pairs(scene):
    with pytest.raises(SceneError, match="none of the 0"):
        converted(Pairing((), (), ""), scene)


def test_thermal_photos_of_two_sizes(made):
    content = {
        f"{i}.jpg": FlirPhoto(raw=FlirPhoto().raw[: 24 - i // 2, :]).jpeg() for i in range(3)
    }
    with pytest.raises(SceneError, match=r"2\.jpg: .*32 x 23.* 0\.jpg .*32 x 24"):
        made(content)


def test_visible_photos_of_two_sizes(made):
    content = {
        f"{i}.jpg": FlirPhoto(visible=photo("jpg", size=(16, 12 + i))).jpeg() for i in range(2)
    }
    with pytest.raises(SceneError, match=r"1\.jpg: .*16 x 13.* 0\.jpg .*16 x 12"):
        made(content)


def remembered(scene: Path) -> dict[str, list]:
    """Stamp and digest of each photo, as kept between calls."""
    return json.loads((scene / "prepare" / CONTENTS).read_text())


@pytest.fixture
def remade(photos, scene):
    """Converts the photos that are there; returns how many pairs were not taken from before."""

    def make(overrides: Overrides | None = None) -> int:
        cache = Cache(scene / "prepare")
        convert_photos(find_pairs(photos({})), scene, overrides or Overrides(), cache, quiet)
        return cache.made

    return make


SET = {
    f"{i}_{mark}": kind
    for i in range(3)
    for mark, kind in (("t.tif", "celsius"), ("rgb.jpg", "jpg"))
}


def test_nothing_is_done_twice(made, remade, photos):
    first = made(SET)
    assert remade() == 0
    assert made({}) == first
    os.utime(photos({"1_rgb.jpg": photo("jpg", taken=NOON)}) / "1_rgb.jpg", ns=(1, 1))
    assert remade() == 1
    assert made({}).views[1].exif.taken == NOON
    assert remade(Overrides(unit="fahrenheit")) == 3


def test_a_photo_exported_again_with_its_old_size_and_time_is_read_again(made, photos, scene):
    made(SET)
    file = photos({}) / "1_t.tif"
    before, status = pixels(scene / "thermal/1.tiff"), file.stat()
    Image.fromarray(pixels(file) + np.float32(5)).save(file)
    assert file.stat().st_size == status.st_size
    os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert made({}).views[1].range_c == (15.0, 35.0)
    np.testing.assert_array_equal(pixels(scene / "thermal/1.tiff"), before + np.float32(5))


def test_a_call_that_was_cut_short_remembers_what_others_read(made, photos, scene):
    made(SET)
    before = remembered(scene)
    pairing, cache = find_pairs(photos({})), Cache(scene / "prepare")

    def stop(step: str, done: int, total: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    (photos({}) / "0_t.tif").touch()
    with pytest.raises(KeyboardInterrupt):
        convert_photos(pairing, scene, Overrides(), cache, stop)
    touched = str(photos({}) / "0_t.tif")
    after = remembered(scene)
    assert after[touched] != before[touched]
    assert after == {**before, touched: after[touched]}


def test_photos_are_read_again_only_where_their_files_changed(made, remade, photos, scene):
    """A photo that was touched is compared by its content, and not converted again; for one that
    was not, what is remembered counts, even if it is wrong."""
    made(SET)
    (photos({}) / "2_t.tif").touch()
    assert remade() == 0
    known = remembered(scene)
    for name in ("1_t.tif", "2_t.tif"):
        known[str(photos({}) / name)][-1] = "of another content"
    (scene / "prepare" / CONTENTS).write_text(json.dumps(known))
    (photos({}) / "2_t.tif").touch()
    assert remade() == 1


def test_a_refused_photo_is_not_read_again(made, remade, scene):
    """Its refusal is kept like an image, until the photo or an override changes."""
    cut = photo("celsius")[:200]
    first = made({**SET, "1_t.tif": cut})
    assert [item.name for item in first.skipped] == ["1"]
    assert "1_t.tif: " in first.skipped[0].reason
    results = contents(scene / "prepare")
    assert made({}) == first
    assert contents(scene / "prepare") == results
    assert remade() == 0
    assert remade(Overrides(unit="fahrenheit")) == 3
    assert [view.name for view in made({"1_t.tif": "celsius"}).views] == ["0", "1", "2"]


def test_a_photo_without_permission_is_read_again(photos, scene):
    """Permissions change neither size nor time: such a refusal is not kept."""
    root = photos(SET)
    pairing = find_pairs(root)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("builtins.open", denied(root / "1_rgb.jpg", open))
        found = converted(pairing, scene)
    assert "1_rgb.jpg: cannot be" in found.skipped[0].reason
    assert converted(pairing, scene).skipped == ()


def test_a_photo_that_another_program_could_not_read_is_tried_again(
    photos, scene, tmp_path, monkeypatch
):
    pairing = find_pairs(photos(R_JPEGS))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SceneError, match="dji_irp"):
        converted(pairing, scene)
    install_dji_tool(tmp_path)
    assert len(converted(pairing, scene).views) == 2


def denied(secret: Path, original):
    """A function that reads files, for a user who may not read one of them."""

    def read(path, *arguments, **options):
        if str(path) == str(secret):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return original(path, *arguments, **options)

    return read


def test_an_image_that_was_removed_is_made_again(made, scene):
    first = made(SET)
    (scene / "images/1.jpg").unlink()
    assert made({}) == first
    assert (scene / "images/1.jpg").is_file()


def test_views_that_are_no_more_are_removed(made, scene, photos):
    made(SET)
    (scene / "images/mine.jpg").write_bytes(b"the user's")
    (photos({}) / "1_t.tif").unlink()
    made({})
    assert sorted(contents(scene / "images")) == ["0.jpg", "2.jpg", "mine.jpg"]
    assert sorted(contents(scene / "thermal")) == ["0.tiff", "2.tiff"]


def test_the_photos_are_only_read(made, photos):
    root = photos(SET)
    before = contents(root)
    made({})
    assert contents(root) == before


class Growing(type(Path())):
    """A file that another program writes: whenever it is looked at, there is more of it."""

    def stat(self, **options: bool) -> os.stat_result:
        with open(self, "ab") as file:
            file.write(b"more")
        return super().stat(**options)


def test_a_photo_that_changes_while_it_is_read(photos, scene):
    pairing = find_pairs(photos(SET))
    pairs = list(pairing.pairs)
    growing = {**pairs[1].photos, RGB: Growing(pairs[1].photos[RGB])}
    pairs[1] = replace(pairs[1], photos=growing)
    found = converted(replace(pairing, pairs=tuple(pairs)), scene)
    assert [view.name for view in found.views] == ["0", "2"]
    assert "1_t.tif" in found.skipped[0].reason
    assert "changed while" in found.skipped[0].reason
    assert sorted(contents(scene / "images")) == ["0.jpg", "2.jpg"]


def test_a_photo_that_vanishes(photos, scene):
    root = photos(SET)
    pairing = find_pairs(root)
    (root / "1_rgb.jpg").unlink()
    found = converted(pairing, scene)
    assert "1_rgb.jpg: " in found.skipped[0].reason
    assert "No such file" in found.skipped[0].reason


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """The system writes no larger files; the test's own are written before."""
    resource = pytest.importorskip("resource", reason="the system limits no sizes")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_an_image_that_cannot_be_written_to_its_end(made, photos, scene):
    """What was written stays whole, and the next call goes on with it."""
    photos({**SET, "1_rgb.jpg": photo("jpg") + bytes(2**20)})
    with largest_file(2**19), pytest.raises(RunError, match=r"1\.jpg cannot"):
        made({})
    assert sorted(contents(scene / "images")) == ["0.jpg"]
    stamp = (scene / "images/0.jpg").stat().st_mtime_ns
    assert len(made({}).views) == 3
    assert (scene / "images/0.jpg").stat().st_mtime_ns == stamp


def test_a_folder_that_cannot_be_made(photos, tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(RunError, match=r"a\.jpg cannot"):
        converted(find_pairs(photos({"a_t.tif": "celsius", "a_rgb.jpg": "jpg"})), tmp_path / "file")


def test_a_photo_that_says_it_holds_another(photos, scene):
    root = photos({"a.jpg": "flir"})
    with pytest.raises(SceneError, match=r"a\.jpg: .*no visible photo"):
        converted(Pairing((PhotoPair("a", {THERMAL: root / "a.jpg"}, True),), (), ""), scene)


def test_progress_is_told(photos, scene):
    told = []
    converted(find_pairs(photos(SET)), scene, progress=lambda *step: told.append(step))
    assert told == [("reading and writing", done, 3) for done in range(4)]
